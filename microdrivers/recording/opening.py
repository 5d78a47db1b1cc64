"""Whether a file is a recording, where it comes from, and what it says itself of losses."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from mcap.records import Schema

from microdrivers.core.errors import ConfigError
from microdrivers.recording.errors import EmptyRecording, ForeignRecording, FutureRecording
from microdrivers.recording.header import (
    CLOCK_RECORD,
    FAILURE_RECORD,
    HEADER_RECORD,
    PROFILE,
    REPAIR_RECORD,
    SCHEMA_VERSION,
    ClockMapping,
    RecordingHeader,
    from_metadata,
)
from microdrivers.recording.mcap_records import read_definition, records_in
from microdrivers.recording.mcap_scan import Loss, McapScan
from microdrivers.recording.schemas import PACKAGE

LIST_MARK = "; "
"""Between the losses in a repaired file's metadata."""
LOST_BEFORE_REPAIR = "lost before the repair: "
"""How a loss begins that a repaired file tells of."""


def open_scan(file: Path) -> McapScan:
    """The intact records of a file.

    Raises:
        ConfigError: there is no such file, or it may not be read.
    """
    try:
        return McapScan(file)
    except OSError as error:
        raise ConfigError(
            f"the recording cannot be read: {error.strerror}", file=str(file), remedy="check the path"
        ) from error


def told_losses(scan: McapScan) -> Iterator[Loss]:
    """What the file's metadata tell of losses."""
    for record in scan.metadata:
        if record.name == REPAIR_RECORD and (losses := record.metadata.get("losses")):
            yield from (Loss(0, 0, f"{LOST_BEFORE_REPAIR}{loss}") for loss in losses.split(LIST_MARK))
        elif record.name == FAILURE_RECORD:
            reason = record.metadata.get("reason", "unknown")
            yield Loss(0, 0, f"the recording was stopped because it could not be written: {reason}")


def read_clock_record(scan: McapScan) -> ClockMapping | None:
    """The last record of the clock that is intact; of others a loss is told."""
    records = [record.metadata for record in scan.metadata if record.name == CLOCK_RECORD]
    read = [from_metadata(data, ClockMapping) for data in records]
    intact = [clock for clock in read if clock is not None]
    if len(intact) < len(read):
        known = "another one is intact" if intact else "how its times relate to the calendar's is not known"
        end = " of its end" if intact and read[-1] is None else ""
        scan.losses.append(Loss(0, 0, f"the recording's clock record{end} is damaged: {known}"))
    return intact[-1] if intact else None


def read_header(scan: McapScan) -> RecordingHeader:
    """The recording's header, if the file is one.

    Raises:
        EmptyRecording, ForeignRecording, FutureRecording: it cannot be read as one.
    """
    file = scan.file
    if scan.size == 0:
        raise EmptyRecording(f"{file} is empty", remedy="record anew: nothing was written to it")
    records = [record.metadata for record in scan.metadata if record.name == HEADER_RECORD]
    headers = [header for data in records if (header := from_metadata(data, RecordingHeader)) is not None]
    if headers:
        _check_version(file, headers[0].schema_version, headers[0].microdrivers)
        if len(headers) < len(records):
            scan.losses.append(Loss(0, 0, "one of the recording's headers is damaged: another one is intact"))
        return headers[0]
    for data in records:
        number = data.get("schema_version", "")
        _check_version(file, int(number) if number.isdecimal() else 0, data.get("microdrivers", ""))
    if scan.profile in (PROFILE, None) and _holds_samples(scan):
        scan.losses.append(Loss(0, 0, "the recording's header is damaged: who made it is not known"))
        return RecordingHeader(source="recorded")
    if not scan.chunks and (scan.profile == PROFILE or (scan.has_magic and scan.profile is None)):
        raise EmptyRecording(f"{file} ends before its first complete record", remedy="record anew")
    what = "an MCAP file, but microdrivers did not write it" if scan.has_magic else "no MCAP file"
    raise ForeignRecording(f"{file} is {what}", remedy="name a file that `microdrivers record` has written")


def _check_version(file: Path, number: int, writer: str) -> None:
    if number > SCHEMA_VERSION:
        raise FutureRecording(
            f"{file} has schema version {number}; this microdrivers reads up to {SCHEMA_VERSION}",
            remedy=f"install the microdrivers that wrote it{writer and f' ({writer})'}, or a newer one",
        )


def _holds_samples(scan: McapScan) -> bool:
    """Whether a message that microdrivers has written is defined in the file."""
    chunks = (scan.read_chunk(place) for place in scan.chunks)
    defined = (
        read_definition(opcode, chunk[start:end])
        for chunk in chunks if isinstance(chunk, bytes)
        for opcode, start, end in records_in(chunk)
    )  # fmt: skip
    return any(
        isinstance(record, Schema) and record.encoding == "protobuf" and record.name.startswith(f"{PACKAGE}.")
        for record in chain(scan.schemas.values(), defined)
    )
