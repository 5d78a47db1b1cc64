"""Protobuf schemas of all sample types, derived from the types themselves; see docs/recording-format.md.

A field has the name of its attribute, unit included. A float becomes a double, which keeps its bits, an int a sfixed64:
both have a fixed size, so that nearly all of a message is read at once. The fields that all samples share have the
numbers 1 to 15, a type's own begin at 16.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple, get_args, get_origin

import msgspec
from google.protobuf import descriptor_pb2

from microdrivers.core import contact_samples as _contact_samples  # noqa: F401 - its types are to be known
from microdrivers.core.samples import Sample

PACKAGE = "microdrivers"
OWN_FIELDS_FROM = 16

Kind = Literal["double", "int", "bool", "string", "bytes", "strings", "doubles", "ints"]
FIXED_KINDS: frozenset[Kind] = frozenset({"double", "int", "bool"})
_REPEATED_KINDS: frozenset[Kind] = frozenset({"strings", "doubles", "ints"})
_SCALARS: dict[object, Kind] = {float: "double", int: "int", bool: "bool", str: "string", bytes: "bytes"}

_Proto = descriptor_pb2.FieldDescriptorProto
_PROTO_TYPES: dict[Kind, _Proto.Type.ValueType] = {
    "double": _Proto.TYPE_DOUBLE, "int": _Proto.TYPE_SFIXED64, "bool": _Proto.TYPE_BOOL, "string": _Proto.TYPE_STRING,
    "bytes": _Proto.TYPE_BYTES, "strings": _Proto.TYPE_STRING, "doubles": _Proto.TYPE_DOUBLE,
    "ints": _Proto.TYPE_SFIXED64,
}  # fmt: skip


class FrameInfo(Sample, frozen=True, gc=False, kw_only=True):
    """All of a `Frame` but its image, which is a foxglove.RawImage on the topic itself; on `<topic>/info`."""

    exposure_ms: float
    frame_id: int
    dropped_before: int
    settings_id: int
    bit_depth: int
    principal_point_px: tuple[float, float]


class Arrivals(msgspec.Struct, frozen=True, kw_only=True):
    """A batch of the order numbers that one estimator's inbox has received, in the order of their arrival."""

    host: str
    orders: tuple[int, ...]


class Drops(msgspec.Struct, frozen=True, kw_only=True):
    """How many samples of a topic are missing so far because the recorder did not keep up, or could not write."""

    topic: str
    dropped: int


class Field(NamedTuple):
    """One field of a message."""

    name: str
    number: int
    kind: Kind


class UnsupportedType(TypeError):
    """A sample type has a field that has no place in the format."""


@functools.cache
def fields_of(message_type: type[msgspec.Struct]) -> tuple[Field, ...]:
    """All fields of a message.

    Raises:
        UnsupportedType: a field is of a type that the format does not know.
    """
    shared = Sample.__struct_fields__ if issubclass(message_type, Sample) else ()
    own_number = OWN_FIELDS_FROM if shared else 1
    fields = []
    for known in msgspec.structs.fields(message_type):
        if known.name in shared:
            number = shared.index(known.name) + 1
        else:
            number, own_number = own_number, own_number + 1
        fields.append(Field(known.name, number, _kind(message_type, known.name, known.type)))
    return tuple(fields)


def _kind(message_type: type[msgspec.Struct], name: str, annotation: Any) -> Kind:
    if annotation in _SCALARS:
        return _SCALARS[annotation]
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal and all(isinstance(argument, str) for argument in arguments):
        return "string"
    if origin is frozenset and arguments == (str,):
        return "strings"
    if origin is tuple and set(arguments) <= {float, ...}:
        return "doubles"
    if origin is tuple and set(arguments) <= {int, ...}:
        return "ints"
    raise UnsupportedType(f"{message_type.__name__}.{name} is {annotation}, which a recording has no field for")


def schema_name(message_type: type[msgspec.Struct]) -> str:
    """Full protobuf name of a message."""
    return f"{PACKAGE}.{message_type.__name__}"


@functools.cache
def schema_data(message_type: type[msgspec.Struct]) -> bytes:
    """The message's serialised google.protobuf.FileDescriptorSet, as MCAP wants it."""
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{PACKAGE}/{message_type.__name__}.proto", package=PACKAGE, syntax="proto3"
    )
    message = file.message_type.add(name=message_type.__name__)
    for field in sorted(fields_of(message_type), key=lambda field: field.number):
        message.field.add(
            name=field.name, json_name=field.name, number=field.number, type=_PROTO_TYPES[field.kind],
            label=_Proto.LABEL_REPEATED if field.kind in _REPEATED_KINDS else _Proto.LABEL_OPTIONAL,
        )  # fmt: skip
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(deterministic=True)


def sample_types() -> dict[str, type[Sample]]:
    """All sample types that there are, by the name of their schema."""
    return {schema_name(found): found for found in _subclasses(Sample)}


def _subclasses(base: type[Sample]) -> Iterator[type[Sample]]:
    for found in base.__subclasses__():
        yield found
        yield from _subclasses(found)
