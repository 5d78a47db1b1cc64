"""What a recording says about itself: where it comes from, and how its times relate to the calendar's."""

from __future__ import annotations

import datetime
import platform
import shlex
import sys
import zlib
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec

from microdrivers.core.clock import Clock, utc_now

SCHEMA_VERSION = 1
PROFILE = "microdrivers"
HEADER_RECORD = "microdrivers"
CLOCK_RECORD = "clock"
REPAIR_RECORD = "repair"
FAILURE_RECORD = "failure"

_CHECKSUM = "crc32"
_EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
_READINGS = 5

RecordT = TypeVar("RecordT", bound=msgspec.Struct)


class RecordingHeader(msgspec.Struct, frozen=True, kw_only=True):
    """Where a recording comes from.

    Attributes:
        schema_version: of the format, see docs/recording-format.md.
        microdrivers, python, libraries: versions that wrote it.
        created_utc: calendar date and time of its start.
        command: the command line.
        source: `live`: devices on ports; `fake`: emulators; `recorded`: made from another recording.
        seed: which simulated world, if it was one.
        rig: name of the rig.
    """

    schema_version: int = SCHEMA_VERSION
    microdrivers: str = ""
    python: str = ""
    libraries: str = ""
    created_utc: str = ""
    command: str = ""
    source: Literal["live", "fake", "recorded"]
    seed: int | None = None
    rig: str = ""


class ClockMapping(msgspec.Struct, frozen=True, kw_only=True):
    """Wall time = rig clock + offset, ns since 1970; the file's log times use `offset_ns`.

    Attributes:
        kind: which clock; a simulated one begins at 0 and has no wall time: the offset is then 0.
        offset_ns, uncertainty_ns: at the recording's start.
        end_offset_ns, end_uncertainty_ns: at its end; None if it has none.
    """

    kind: Literal["simulated", "system"]
    offset_ns: int
    uncertainty_ns: int
    end_offset_ns: int | None = None
    end_uncertainty_ns: int | None = None


def describe_recording(
    *, source: Literal["live", "fake", "recorded"], seed: int | None = None, rig: str = ""
) -> RecordingHeader:
    """The header of a recording that begins now."""
    return RecordingHeader(
        microdrivers=version("microdrivers"),
        python=platform.python_version(),
        libraries=", ".join(f"{name} {version(name)}" for name in ("mcap", "protobuf", "numpy", "msgspec")),
        created_utc=utc_now().isoformat(timespec="seconds"),
        command=shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        source=source,
        seed=seed,
        rig=rig,
    )


def read_clock(clock: Clock) -> ClockMapping:
    """How the rig's clock and the calendar's relate now."""
    if clock.simulated:
        return ClockMapping(kind="simulated", offset_ns=0, uncertainty_ns=0)
    readings = []
    for _ in range(_READINGS):
        before_ns = clock.now_ns()
        wall = utc_now()
        after_ns = clock.now_ns()
        # The calendar is read in whole µs.
        wall_ns = (wall - _EPOCH) // datetime.timedelta(microseconds=1) * 1000
        readings.append(((after_ns - before_ns) // 2 + 1000, wall_ns - (before_ns + after_ns) // 2))
    uncertainty_ns, offset_ns = min(readings)
    return ClockMapping(kind="system", offset_ns=offset_ns, uncertainty_ns=uncertainty_ns)


def to_metadata(record: msgspec.Struct) -> dict[str, str]:
    """The record as MCAP metadata, with a checksum of its own, which MCAP's metadata lack; None is left out."""
    data = {key: str(value) for key, value in msgspec.structs.asdict(record).items() if value is not None}
    return data | {_CHECKSUM: _checksum(data)}


def from_metadata(data: Mapping[str, str], record_type: type[RecordT]) -> RecordT | None:
    """The record, or None if it is damaged; keys that are not known are left out."""
    rest: dict[str, Any] = dict(data)
    if rest.pop(_CHECKSUM, None) != _checksum(rest):
        return None
    try:
        return msgspec.convert(rest, record_type, strict=False)
    except msgspec.ValidationError:
        return None


def _checksum(data: Mapping[str, str]) -> str:
    return f"{zlib.crc32(repr(sorted(data.items())).encode()):08x}"
