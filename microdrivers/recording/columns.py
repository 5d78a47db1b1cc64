"""The fields of a sample type as columns: unit, description, and how a value becomes numbers or text."""

from __future__ import annotations

import functools
import inspect
import re
from typing import Any, Literal, NamedTuple, get_args

import msgspec
import numpy as np

from microdrivers.core.samples import Frame, Sample
from microdrivers.recording.schemas import FrameInfo, Kind, fields_of

Shape = Literal["one", "fixed", "any"]

_UNITS = {
    "px_per_um": "px/um", "uN_per_um": "uN/um", "uN_per_um3": "uN/um^3", "uN_s_per_um": "uN*s/um", "um_s": "um/s",
    "per_s": "1/s", "um": "um", "deg": "deg", "px": "px", "uN": "uN", "kg": "kg", "ns": "ns", "ms": "ms", "s": "s",
    "steps": "steps",
}  # fmt: skip
_NAMES = re.compile(r"\b([a-z]\w*(?:_\*)?(?:, [a-z]\w*(?:_\*)?)*): ")


class Column(NamedTuple):
    """One field of a sample type.

    Attributes:
        name: of the field, its unit included. unit: alone, such as `um` or `px/um`; empty if it has none.
        description: what the sample type says of it; empty if nothing.
        kind: of the value, or of a tuple's elements.
        shape: one value, a tuple of `length` values, or a tuple of any length.
    """

    name: str
    unit: str
    description: str
    kind: Kind
    shape: Shape
    length: int

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of one element; texts, bytes and tuples of any length are objects."""
        kinds = {"double": "f8", "doubles": "f8", "int": "i8", "ints": "i8", "bool": "?"}
        return np.dtype("O" if self.shape == "any" else kinds.get(self.kind, "O"))

    def value(self, sample: Sample) -> Any:
        """The field's value; flags as one text, in alphabetical order, bytes as hexadecimal digits."""
        found = getattr(sample, self.name)
        if self.kind == "strings":
            return " ".join(sorted(found))
        return found.hex() if self.kind == "bytes" else found


@functools.cache
def columns_of(sample_type: type[Sample]) -> tuple[Column, ...]:
    """The columns of a sample type: its own fields behind those that all samples share; a frame's image is none."""
    known = FrameInfo if sample_type is Frame else sample_type
    types = {field.name: field.type for field in msgspec.structs.fields(known)}
    described: dict[str, str] = {}
    for kind in reversed(sample_type.__mro__):
        described |= _descriptions(kind) if issubclass(kind, Sample) else {}
    columns = []
    for field in fields_of(known):
        shape, length = _shape(field.kind, types[field.name])
        columns.append(
            Column(field.name, unit_of(field.name), described.get(field.name, ""), field.kind, shape, length)
        )
    return tuple(columns)


def describe(sample_type: type[Sample]) -> str:
    """What the samples of a type are, in a sentence or two."""
    return (inspect.getdoc(sample_type) or "").split("\n\nAttributes:")[0].replace("\n", " ")


def unit_of(name: str) -> str:
    """The unit that a field's name ends in; empty if it has none."""
    parts = name.split("_")
    return next((_UNITS[tail] for n in range(1, len(parts)) if (tail := "_".join(parts[n:])) in _UNITS), "")


def _shape(kind: Kind, annotation: Any) -> tuple[Shape, int]:
    if kind not in ("doubles", "ints"):
        return "one", 1
    arguments = get_args(annotation)
    return ("any", 0) if Ellipsis in arguments else ("fixed", len(arguments))


def _descriptions(sample_type: type[Sample]) -> dict[str, str]:
    """What the docstring says of each attribute; `name, name: text` stands for all of these names."""
    text = " ".join((inspect.getdoc(sample_type) or "").partition("Attributes:")[2].split())
    found: dict[str, str] = {}
    matches = list(_NAMES.finditer(text))
    ends = [*(match.start() for match in matches[1:]), len(text)]
    for match, end in zip(matches, ends, strict=False):
        said = text[match.end() : end].strip().rstrip(".")
        found |= dict.fromkeys(match[1].split(", "), said)
    return {name: said for name, said in found.items() if name in sample_type.__struct_fields__}
