r"""The wire log: a text file that tells what passed on the wires of a rig, one JSON object a line.

The first line is the header, each further line one record:

    {"t_s": 0.012345678, "device": "sample_stage", "direction": "sent", "text": "POS?\n"}
    {"t_s": 0.015004000, "device": "zoom", "direction": "received", "hex": "01 03 04 00 00 00 20 FB EB"}
    {"t_s": 0.020000000, "device": "zoom", "event": "opened"}
    {"t_s": 0.021000000, "device": "CAN can0", "direction": "sent", "text": "60B#4000100000000000"}

`t_s` counts from the log's start on the rig's clock. Directions are the host's. `text` and `hex` are two ways to write
the same bytes. One reply may be spread over several records. Of a CAN bus, which devices share, a record is one frame
in candump's notation. See docs/decisions/0012.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import msgspec

from microdrivers.core.errors import ConfigError
from microdrivers.core.samples import DeviceEvent, EventKind, WireTraffic
from microdrivers.core.units import NS_PER_S, seconds_to_ns

FORMAT: Literal["microdrivers-wire-log"] = "microdrivers-wire-log"
VERSION = 1

_LONGEST_S = 1e9
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_READABLE = frozenset(range(0x20, 0x7F)) | frozenset(b"\t\n\r") | frozenset(b"\x04\x05\x07\x08\x18")
"""Printable ASCII, and the control characters of line-based command languages: line ends, and the requests and stops
of one byte (PI GCS #4, #5, #7, #8, #24)."""

LoggedSample = WireTraffic | DeviceEvent
DecodedT = TypeVar("DecodedT")

_log = logging.getLogger(__name__)


class WireLogHeader(msgspec.Struct, frozen=True, kw_only=True):
    """The first line.

    Attributes:
        microdrivers: version that wrote the log.
        created_utc: calendar date and time of the log's start.
        command: the command line.
        source: `live`: devices on ports; `fake`: emulators in process, which start anew with each run; `served`:
            emulators on ports, seen from their side.
        seed: which simulated world, if it was one.
        rig: the rig file as plain data, all defaults filled in.
    """

    format: Literal["microdrivers-wire-log"] = FORMAT
    version: int = VERSION
    microdrivers: str
    created_utc: str
    command: str = ""
    source: Literal["live", "fake", "served"]
    seed: int | None = None
    rig: dict[str, Any]


class WireLog(NamedTuple):
    """A wire log that has been read; times in ns since its start."""

    header: WireLogHeader
    records: list[LoggedSample]


class _Kind(msgspec.Struct):
    """What every version of the header begins with."""

    format: Literal["microdrivers-wire-log"]
    version: int


class _Record(msgspec.Struct, forbid_unknown_fields=True):
    t_s: float
    device: str
    direction: Literal["sent", "received"] | None = None
    text: str | None = None
    hex: str | None = None
    event: EventKind | None = None
    by: str = ""
    reason: str = ""


# ---------------------------------------------------------------------- writing


def header_line(header: WireLogHeader) -> str:
    """The header as a line of the file."""
    return json.dumps(msgspec.to_builtins(header), ensure_ascii=False) + "\n"


def record_line(sample: LoggedSample, *, start_ns: int) -> str:
    """A sample as a line of the file; `start_ns` is the log's start."""
    if isinstance(sample, WireTraffic):
        key, shown = _written(sample.data)
        fields = {"device": sample.device, "direction": sample.direction, key: shown}
    else:
        named = {"device": sample.device, "event": sample.kind, "by": sample.by, "reason": sample.reason}
        fields = {key: text for key, text in named.items() if text}
    return f'{{"t_s": {_seconds(sample.t_ns - start_ns)}, {json.dumps(fields)[1:]}\n'


def bytes_text(data: bytes) -> str:
    """Bytes for people, as the log writes them."""
    key, shown = _written(data)
    return json.dumps(shown) if key == "text" else shown


def _written(data: bytes) -> tuple[Literal["text", "hex"], str]:
    if _READABLE.issuperset(data):
        return "text", data.decode("ascii")
    return "hex", data.hex(" ").upper()


def _seconds(t_ns: int) -> str:
    whole, rest = divmod(abs(t_ns), NS_PER_S)
    return f"{'-' if t_ns < 0 else ''}{whole}.{rest:09d}"


# ---------------------------------------------------------------------- reading


def read_header(file: Path) -> WireLogHeader:
    """Read the first line only.

    Raises:
        ConfigError: as `read_wire_log`.
    """
    return _header(file, next(_lines(file), (1, b""))[1])


def read_wire_log(file: Path) -> WireLog:
    """Read a wire log. A last line that was cut off, as a crash leaves it, is left out with a warning.

    Raises:
        ConfigError: no such file, not a wire log, one of a newer version, or a line that is not a record; with line
            and what to do.
    """
    lines = _lines(file)
    header = _header(file, next(lines, (1, b""))[1])
    records: list[LoggedSample] = []
    for number, line in lines:
        if not line.strip():
            continue
        try:
            records.append(_sample(_decode(line, _Record)))
        except ValueError as error:
            if not line.endswith(b"\n"):
                _log.warning("%s: line %d was cut off and is left out", file, number)
                break
            raise ConfigError(
                f"not a record of a wire log: {error}", file=str(file), line=number,
                remedy='write one JSON object a line, as {"t_s": 0.5, "device": "zoom", "direction": "sent", '
                '"hex": "01 03"}, or remove the line',
            ) from error  # fmt: skip
    return WireLog(header, records)


def _lines(file: Path) -> Iterator[tuple[int, bytes]]:
    try:
        with file.open("rb") as stream:
            for number, line in enumerate(stream, start=1):
                yield number, line.removeprefix(_BYTE_ORDER_MARK) if number == 1 else line
    except FileNotFoundError as error:
        raise ConfigError("there is no such file", file=str(file), remedy="check the path") from error
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", file=str(file), remedy="give a wire log") from error


def _header(file: Path, line: bytes) -> WireLogHeader:
    try:
        kind = _decode(line, _Kind)
    except ValueError as error:
        raise ConfigError(
            "not a wire log", file=str(file), line=1, remedy="give a file that --wire-log has written"
        ) from error
    if kind.version != VERSION:
        raise ConfigError(
            f"wire log of version {kind.version}; this microdrivers reads version {VERSION}", file=str(file), line=1,
            remedy="use the version of microdrivers that wrote it, or a newer one",
        )  # fmt: skip
    try:
        return _decode(line, WireLogHeader)
    except ValueError as error:
        raise ConfigError(
            f"the log's header is damaged: {error}", file=str(file), line=1,
            remedy="restore the first line as it was written, or take the log again",
        ) from error  # fmt: skip


def _decode(line: bytes, kind: type[DecodedT]) -> DecodedT:
    """Decode a line; whatever is wrong with it is a ValueError."""
    try:
        return msgspec.json.decode(line, type=kind)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def _sample(record: _Record) -> LoggedSample:
    if not math.isfinite(record.t_s) or abs(record.t_s) > _LONGEST_S:
        raise ValueError(f"t_s {record.t_s} is not a time")
    t_ns = seconds_to_ns(record.t_s)
    traffic = (record.direction, record.text if record.text is not None else record.hex)
    if record.event is not None:
        if traffic != (None, None):
            raise ValueError("a record is an event or bytes, not both")
        return DeviceEvent(
            t_ns=t_ns, device=record.device, t_source="recorded", kind=record.event, by=record.by, reason=record.reason
        )
    if record.direction is None or (record.text is None) == (record.hex is None):
        raise ValueError("a record needs an event, or a direction and either text or hex")
    return WireTraffic(
        t_ns=t_ns, device=record.device, t_source="recorded", direction=record.direction, data=_bytes_of(record)
    )


def _bytes_of(record: _Record) -> bytes:
    try:
        return record.text.encode("ascii") if record.text is not None else bytes.fromhex(record.hex or "")
    except UnicodeEncodeError as error:
        raise ValueError("text may hold ASCII only; write other bytes as hex") from error
    except ValueError as error:
        raise ValueError("hex needs pairs of hexadecimal digits") from error
