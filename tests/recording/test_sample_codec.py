"""Samples as protobuf: bit for bit, in a layout of our own, and readable by anybody who has the schema."""

import math
import struct

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.samples import ForceSample, Frame, PoseSample, Sample
from microdrivers.recording.codec import codec_of, decoder_for
from microdrivers.recording.schemas import (
    Arrivals,
    Drops,
    FrameInfo,
    UnsupportedType,
    fields_of,
    sample_types,
    schema_data,
)

NOTES = [Arrivals, Drops]
TYPES = [kind for kind in sample_types().values() if kind is not Frame and kind.__module__.startswith("microdrivers.")]
INTS = st.one_of(st.integers(-(2**63), 2**63 - 1), st.sampled_from([0, -1, -(2**63), 2**63 - 1]))
# Any 64 bits: NaNs with payloads, infinities, −0 and denormal numbers are all among them.
FLOATS = st.one_of(
    st.binary(min_size=8, max_size=8).map(lambda raw: struct.unpack("<d", raw)[0]),
    st.sampled_from([math.nan, *struct.unpack("<d", bytes.fromhex("0100efbeaddef07f")), -0.0, math.inf, -math.inf]),
)
TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
VALUES = {
    "double": FLOATS, "int": INTS, "bool": st.booleans(), "string": TEXTS, "bytes": st.binary(max_size=40),
    "strings": st.frozensets(TEXTS, max_size=4), "doubles": st.lists(FLOATS, max_size=40).map(tuple),
    "ints": st.lists(INTS, max_size=40).map(tuple),
}  # fmt: skip


def messages(kind):
    return st.builds(kind, **{field.name: VALUES[field.kind] for field in fields_of(kind)})


def bits(value):
    if isinstance(value, float):
        return struct.pack("<d", value)
    return tuple(map(bits, value)) if isinstance(value, tuple) else value


def all_bits(message):
    return {name: bits(getattr(message, name)) for name in type(message).__struct_fields__}


def library_class(kind):
    """The message class that a stranger gets from the embedded schema alone."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema_data(kind)).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"microdrivers.{kind.__name__}"))


@pytest.mark.parametrize("kind", [*TYPES, *NOTES], ids=lambda kind: kind.__name__)
def test_every_type_comes_back_bit_for_bit(kind):
    codec, stranger = codec_of(kind), library_class(kind)

    @settings(max_examples=40)
    @given(messages(kind))
    def check(message):
        data = codec.encode(message)
        assert all_bits(codec.decode(data)) == all_bits(message)
        read = stranger.FromString(data)
        for field in fields_of(kind):
            expected, found = getattr(message, field.name), getattr(read, field.name)
            if field.kind == "strings":
                assert list(found) == sorted(expected)
            else:
                assert bits(tuple(found) if field.kind in ("doubles", "ints") else found) == bits(expected)
        # Written by the library, whose layout is another one, it is read all the same.
        assert all_bits(decoder_for(kind, schema_data(kind))(read.SerializeToString())) == all_bits(message)

    check()


def test_the_schemas_of_all_types_differ():
    assert len({schema_data(kind) for kind in [*TYPES, *NOTES]}) == len(TYPES) + len(NOTES)


def test_a_frame_info_is_a_frame_without_its_image():
    own, shared = set(FrameInfo.__struct_fields__), set(Frame.__struct_fields__)
    assert own == shared - {"image"}


def test_a_recording_of_an_older_type_is_read_by_name():
    old = descriptor_pb2.FileDescriptorSet.FromString(schema_data(ForceSample))
    message = old.file[0].message_type[0]
    for field in list(message.field):
        if field.name == "tare_uN":
            message.field.remove(field)
        elif field.name == "raw_uN":
            field.number = 90
    message.field.add(name="gone", number=91, type=1, label=1)
    schema = old.SerializeToString()
    pool = descriptor_pool.DescriptorPool()
    pool.Add(old.file[0])
    written = message_factory.GetMessageClass(pool.FindMessageTypeByName("microdrivers.ForceSample"))(
        t_ns=5, device="x", force_uN=1.5, raw_uN=2.5, gone=7.0, flags=["STALE"]
    )
    found = decoder_for(ForceSample, schema)(written.SerializeToString())
    expected = ForceSample(
        t_ns=5, device="x", t_source="", order=0, force_uN=1.5, raw_uN=2.5, flags=frozenset({"STALE"})
    )
    assert found == expected


def test_a_type_that_has_no_place_in_the_format_is_refused():
    class Odd(Sample, frozen=True, kw_only=True):
        what: dict[str, int]

    with pytest.raises(UnsupportedType, match=r"Odd\.what"):
        codec_of(Odd)


def test_the_common_fields_keep_their_numbers():
    numbers = [(field.name, field.number) for field in fields_of(PoseSample)]
    assert numbers == [
        ("t_ns", 1), ("device", 2), ("dt_ns", 3), ("t_source", 4), ("seq", 5), ("order", 6), ("flags", 7),
        ("moving", 16), ("on_target", 17), ("referenced", 18),
    ]  # fmt: skip
