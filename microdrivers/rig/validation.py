"""Checks plain data against a model; what is wrong with it is said in plain words, with its place and a remedy."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TypeVar, get_args

import pydantic

from microdrivers.core.errors import ConfigError
from microdrivers.rig.yaml_file import Document, Location

ModelT = TypeVar("ModelT", bound=pydantic.BaseModel)

_AS_JSON = pydantic.TypeAdapter(Any, config=pydantic.ConfigDict(ser_json_inf_nan="constants"))
_CORRECT = "correct the value"
_LONGEST_SHOWN = 60
_CLOSE = 0.7
"""Of two spellings, as difflib measures: a slip of the pen, and not another word."""

_MAPPING, _NUMBER, _WHOLE_NUMBER = "a mapping of keys to values", "a number", "a whole number"
_NEEDED = {
    "bool_type": "true or false",
    "dict_type": _MAPPING,
    "finite_number": "a finite number",
    "float_type": _NUMBER,
    "int_type": _WHOLE_NUMBER,
    "list_type": "a list",
    "model_type": _MAPPING,
    "named_tuple_type": "a list",
    "string_type": "text",
    "tuple_type": "a list",
}
_REMEDIES = {
    "true or false": "write true or false, without quotes",
    "a list": "write the values in brackets, as [1, 2]",
    _MAPPING: "write key: value, a line for each and indented, or all in braces",
}


def validate(
    model: type[ModelT], data: Any, document: Document, location: Location = ()
) -> tuple[ModelT | None, list[ConfigError]]:
    """Check `data`, which stands at `location` of the document, against a model; all errors at once.

    A `ValueError` of a validator may read `KEY … what is wrong; what to do`: if a key of the section that is validated
    comes first, that is the error's place.
    """
    if not isinstance(data, dict):
        kind = "nothing" if data is None else type(data).__name__
        return None, [document.error(f"{_MAPPING} is needed here, not {kind}", location, remedy=_REMEDIES[_MAPPING])]
    try:
        return model.model_validate_json(_AS_JSON.dump_json(data)), []
    except pydantic.ValidationError as error:
        found = _by_place(error.errors(include_url=False), data)
        return None, [_explain(details, place, model, document, location) for place, details in found]


def suggest(name: str, known: Iterable[str]) -> str:
    """What to do about a name that is none of the known ones."""
    known = list(known)
    return _meant(name, known) or (
        f"name one of {', '.join(known)}" if known else "leave it out: there is none that could be named"
    )


def _meant(written: Any, known: Iterable[str]) -> str:
    """The question after the known word that is nearly what was written; empty if none is."""
    close = difflib.get_close_matches(str(written), list(known), n=1, cutoff=_CLOSE)
    return f"did you mean {close[0]!r}?" if close else ""


def _by_place(details: Iterable[Any], data: Any) -> list[tuple[Location, list[Any]]]:
    """What pydantic has found, by where in the data: one mistake may have several details."""
    found: dict[Location, list[Any]] = {}
    for detail in details:
        place, missing = _place(detail, data), detail["type"] == "missing"
        if missing and isinstance(place[-1], int):
            place = place[:-1]  # of a list that is too short, all that is missing is one mistake
        found.setdefault(place, []).append(detail)
    within = {place[:end] for place in found for end in range(len(place))}
    # A list that holds something wrong is also called too short.
    return [(place, each) for place, each in found.items() if not (place in within and each[0]["type"] == "too_short")]


def _place(detail: Any, data: Any) -> Location:
    """The location in the data, without the names of variants that pydantic puts in between."""
    loc, place, here = detail["loc"], [], data
    for part in loc:
        inner = {str(key): key for key in here} if isinstance(here, dict) else {}
        if isinstance(here, list) and part in range(len(here)):
            here = here[part]
        elif part in inner:
            here = here[inner[part]]
        else:
            continue
        place.append(part)
    return (*place, loc[-1]) if detail["type"] == "missing" else tuple(place)


def _explain(
    details: list[Any], place: Location, model: type[pydantic.BaseModel], document: Document, location: Location
) -> ConfigError:
    where: Location = (*location, *place)
    detail = details[0]
    kind, value, context = detail["type"], detail["input"], detail.get("ctx", {})
    if len({each["type"] for each in details} & _NEEDED.keys()) > 1:
        return document.error(_mismatch(value, [_NEEDED[each["type"]] for each in details]), where, remedy=_CORRECT)
    if kind in _NEEDED:
        return document.error(_mismatch(value, [_NEEDED[kind]]), where, remedy=_remedy(value, _NEEDED[kind]))
    if kind == "extra_forbidden":
        return document.error("unknown key", where, remedy=_known_keys(model, detail["loc"]))
    if kind == "missing" and isinstance(detail["loc"][-1], int):
        return _wrong_length(value, f"{1 + max(each['loc'][-1] for each in details)}", document, where)
    if kind == "union_tag_not_found":
        where = (*where, context["discriminator"].strip("'"))
    if kind in ("missing", "union_tag_not_found"):
        return document.error("required key is missing", where, remedy=f"add {where[-1]!r}")
    if kind in ("too_long", "too_short"):
        needed = str(context["max_length"]) if kind == "too_long" else f"{context['min_length']} or more"
        return _wrong_length(value, needed, document, where)
    if kind in ("literal_error", "union_tag_invalid"):
        if kind == "union_tag_invalid":
            value, where = context["tag"], (*where, context["discriminator"].strip("'"))
        return _no_choice(value, context.get("expected") or context["expected_tags"], document, where)
    if kind == "string_too_short":
        return document.error("the text is empty", where, remedy="write what is meant, or leave the key out")
    if kind == "int_parsing_size":
        return document.error("the number is far too large", where, remedy=_CORRECT)
    if kind == "value_error":
        return _of_validator(detail["msg"].removeprefix("Value error, "), value, document, where)
    return document.error(f"{detail['msg'].replace('Input should', 'it must')}{_shown(value)}", where, remedy=_CORRECT)


def _mismatch(value: Any, needed: Sequence[str]) -> str:
    wanted = " or ".join(dict.fromkeys(needed))
    if value is None:
        return f"nothing stands here; {wanted} is needed"
    text = repr(value)
    return f"{text if len(text) <= _LONGEST_SHOWN else text[:_LONGEST_SHOWN] + '…'} is not {wanted}"


def _remedy(value: Any, needed: str) -> str:
    if needed == "text" and isinstance(value, int | float):
        return "put it in quotes"
    if needed in (_NUMBER, _WHOLE_NUMBER):
        meant = _number_meant(value)
        return f"write the bare number{f': {meant}' if meant else '; its unit is part of the key'}"
    return _REMEDIES.get(needed, _CORRECT)


def _number_meant(value: Any) -> str:
    """The number that somebody has put into quotes or has written as only programs do; a whole one as 2e4."""
    if isinstance(value, float) and value.is_integer():
        return f"{value:.0f}"
    is_text = isinstance(value, str) and any(character.isdigit() for character in value)
    for convert in (int, float, lambda text: int(text, 0)) if is_text else ():
        try:
            return str(convert(value))
        except ValueError:
            continue
    return ""


def _wrong_length(value: Any, needed: str, document: Document, where: Location) -> ConfigError:
    number = len(value) if isinstance(value, Sequence) else 0
    return document.error(
        f"{needed} values are needed here, not {number}", where, remedy="write that many, all in one pair of brackets"
    )


def _no_choice(value: Any, expected: str, document: Document, where: Location) -> ConfigError:
    if value is None:
        return document.error(f"nothing stands here; {expected} is needed", where, remedy="add a value")
    number = _number_meant(value)
    if number in re.findall(r"[-\d]+", expected):
        remedy = f"write the bare number: {number}"
    else:
        remedy = _meant(value, re.findall(r"'([^']*)'", expected)) or _CORRECT
    return document.error(f"{value!r} is not possible here: it must be {expected}", where, remedy=remedy)


def _of_validator(message: str, value: Any, document: Document, where: Location) -> ConfigError:
    what, _, remedy = message.partition("; ")
    first = re.match(r"[A-Za-z_][\w.]*", what)
    keys: Location = tuple(first.group().strip(".").split(".")) if first else ()
    if where and keys[:1] == where[-1:]:
        keys = keys[1:]
    named = (*where, *keys)
    shown = "" if str(value) in what else _shown(value)
    return document.error(f"{what}{shown}", named if named in document.places else where, remedy=remedy or _CORRECT)


def _shown(value: Any) -> str:
    return f" (it is {value!r})" if isinstance(value, str | int | float) else ""


def _known_keys(model: type[pydantic.BaseModel], loc: Sequence[str | int]) -> str:
    """What to do about an unknown key, from those that the model has in its place."""
    models = [model]
    for part in loc[:-1]:
        if isinstance(part, int):
            continue
        fields = [each.model_fields[part].annotation for each in models if part in each.model_fields]
        variants = [each for each in models if any(part in get_args(f.annotation) for f in each.model_fields.values())]
        models = [inner for field in fields for inner in _models_in(field)] if fields else variants or models
    known = list(dict.fromkeys(key for each in models for key in each.model_fields))
    return _meant(loc[-1], known) or f"known keys here: {', '.join(known)}"


def _models_in(annotation: Any) -> Iterator[type[pydantic.BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, pydantic.BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models_in(inner)
