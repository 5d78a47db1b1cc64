"""YAML with a memory of where everything stood, so that an error can name file, line and column."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from microdrivers.core.errors import ConfigError, ConfigErrors

Location = tuple[str | int, ...]


class Place(NamedTuple):
    """Line and column, both from 1."""

    line: int
    column: int


class Document(NamedTuple):
    """A YAML file as plain data, and the place of every key and value in it."""

    file: Path
    data: Any
    places: dict[Location, Place]

    def place_of(self, location: Sequence[str | int]) -> Place:
        """The place of a location, or of the nearest thing around it that the file does contain."""
        known = tuple(location)
        while known and known not in self.places:
            known = known[:-1]
        return self.places.get(known, Place(1, 1))

    def error(self, what: str, location: Sequence[str | int], *, remedy: str = "") -> ConfigError:
        """An error at a location of this file."""
        line, column = self.place_of(location)
        key = ".".join(str(part) for part in location)
        return ConfigError(what, remedy=remedy, file=str(self.file), line=line, column=column, key=key)


class _CoreLoader(yaml.SafeLoader):
    """YAML 1.2's core schema: 1e-5 is a number, `on`, `12:30` and dates are text."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 - PyYAML's own name


for _tag, _pattern, _first in (
    ("bool", r"^(?:true|True|TRUE|false|False|FALSE)$", "tTfF"),
    ("null", r"^(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
    ("int", r"^[-+]?[0-9]+$", "-+0123456789"),
    ("float", r"^[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?$", "-+.0123456789"),
    ("float", r"^(?:[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$", "-+."),
):
    _CoreLoader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), list(_first))


def _integer(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int:
    return int(loader.construct_scalar(node), 10)


def _float(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> float:
    text = loader.construct_scalar(node)
    sign, digits = ("-", text[1:]) if text.startswith("-") else ("", text.removeprefix("+"))
    return float(sign + (digits[1:] if digits.lower() in (".inf", ".nan") else digits))


_CoreLoader.add_constructor("tag:yaml.org,2002:int", _integer)
_CoreLoader.add_constructor("tag:yaml.org,2002:float", _float)


def _on_libyaml() -> Any:
    """The same loader on libyaml, seven times as fast; itself where PyYAML was built without."""
    fast = getattr(yaml, "CSafeLoader", None)
    own = {name: getattr(_CoreLoader, name) for name in ("yaml_implicit_resolvers", "yaml_constructors")}
    return _CoreLoader if fast is None else type("_FastCoreLoader", (fast,), own)


_FastCoreLoader = _on_libyaml()


def read_document(file: Path) -> Document:
    """Read a YAML file.

    Raises:
        ConfigError: it does not exist, is not text, is no valid YAML, or repeats a key.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise ConfigError("there is no such file", file=str(file), remedy="check the path") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read: {error}", file=str(file), remedy="give a YAML text file") from error
    try:
        try:
            return _parse(file, _FastCoreLoader(text))
        except yaml.YAMLError:
            return _parse(file, _CoreLoader(text))  # which says more exactly what is wrong
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = Place(mark.line + 1, mark.column + 1) if mark else Place(1, 1)
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        if problem.startswith("but "):
            problem = f"{getattr(error, 'context', '')}, {problem}"
        raise ConfigError(
            f"not valid YAML: {problem}",
            file=str(file), line=place.line, column=place.column,
            remedy="check indentation, colons and quotes around that place",
        ) from error  # fmt: skip
    except (ValueError, AttributeError, TypeError, RecursionError) as error:
        raise ConfigError(
            f"not a plain YAML file: {error}", file=str(file), line=1, column=1,
            remedy="write plain values: no tags (!!…), no references (&…, *…)",
        ) from error  # fmt: skip


def _parse(file: Path, loader: Any) -> Document:
    try:
        root = loader.get_single_node()
        places: dict[Location, Place] = {}
        if root is not None:
            _note_places(root, (), places, file)
        return Document(file, loader.construct_document(root) if root is not None else None, places)
    finally:
        loader.dispose()


def _note_places(node: yaml.Node, location: Location, places: dict[Location, Place], file: Path) -> None:
    places.setdefault(location, Place(node.start_mark.line + 1, node.start_mark.column + 1))
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            inner = (*location, str(key.value))
            place = Place(key.start_mark.line + 1, key.start_mark.column + 1)
            if inner in places:
                raise ConfigError(
                    "the key is given twice", file=str(file), line=place.line, column=place.column,
                    key=".".join(map(str, inner)), remedy="keep one of them",
                )  # fmt: skip
            places[inner] = place
            _note_places(value, inner, places, file)
    elif isinstance(node, yaml.SequenceNode):
        for i, item in enumerate(node.value):
            _note_places(item, (*location, i), places, file)


def raise_all(document: Document, errors: Sequence[ConfigError]) -> None:
    """Raise what was found, if anything: one error as itself, several as one tree."""
    if len(errors) == 1:
        raise errors[0]
    if errors:
        raise ConfigErrors(f"{document.file} has {len(errors)} mistakes:", errors)
