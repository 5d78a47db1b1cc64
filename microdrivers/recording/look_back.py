"""Whether a file still is as it was written, and what a reader finds of it if another program has written to it."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path

from mcap.opcode import Opcode

from microdrivers.recording.mcap_records import MESSAGE, RECORD, Written, records_in
from microdrivers.recording.mcap_scan import McapScan


def is_as_written(file: Path, written: Sequence[Written], size: int) -> bool:
    """Whether the file has that size, and begins and ends as it was written: what comes first, and the last chunk.

    Raises:
        OSError: it cannot be read.
    """
    chunks = [record for record in written if record.is_chunk]
    looked_at = [*takewhile(lambda record: not record.is_chunk, written), *chunks[:1], *chunks[-1:]]
    with file.open("rb", buffering=0) as stream:
        number = stream.fileno()
        return os.fstat(number).st_size == size and all(
            os.pread(number, len(record.head), record.offset) == record.head for record in looked_at
        )


def messages_left(file: Path, written: Sequence[Written]) -> Counter[int]:
    """How many messages of which channel a reader finds in the chunks that were written; it reads all of the file.

    Raises:
        OSError: it cannot be read.
    """
    left: Counter[int] = Counter()
    scan = McapScan(file)
    try:
        places = {place.offset: place for place in scan.chunks}
        for record in written:
            place = places.get(record.offset)
            if place is None or not record.is_chunk or not scan.begins_with(place, record.head):
                continue
            chunk = scan.read_chunk(place)
            if isinstance(chunk, bytes):
                left.update(
                    MESSAGE.unpack_from(chunk, start - RECORD.size)[2]
                    for opcode, start, _ in records_in(chunk)
                    if opcode == Opcode.MESSAGE
                )
    finally:
        scan.close()
    return left
