"""The file that a recording is written to."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from microdrivers.core.errors import ConfigError
from microdrivers.recording.mcap_writer import Output


class OutputFile(Output, Protocol):
    """An output that can be closed."""

    def close(self) -> None:
        """No more is written."""


@contextmanager
def whole_file(file: Path) -> Iterator[Path]:
    """Gives the name of a file beside `file`, which takes its place when it is complete and on the disk.

    Whatever ends the program meanwhile, `file` is whole or as it was; a kill may leave `<name>.<number>.part`.
    """
    part = file.with_name(f"{file.name}.{os.getpid()}.part")
    try:
        yield part
        with part.open("rb") as written:
            os.fsync(written.fileno())
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)


def create_file(file: Path) -> OutputFile:
    """A new, unbuffered file.

    Raises:
        ConfigError: it exists, or cannot be made.
    """
    refuse_existing(file)
    try:
        return file.open("x+b", buffering=0)
    except OSError as error:
        raise not_writable(file, error) from error


def refuse_existing(file: Path, what: str = "a recording") -> None:
    """See that nothing would be overwritten.

    Raises:
        ConfigError: the file exists.
    """
    if os.path.lexists(file):
        raise ConfigError(
            f"the file already exists, and {what} is never overwritten", file=str(file),
            remedy="choose another name, or remove the file",
        )  # fmt: skip


def not_writable(file: Path, error: OSError) -> ConfigError:
    """What to tell the user of a file that cannot be written."""
    return ConfigError(
        f"the recording cannot be written there: {error.strerror or error}", file=str(file),
        remedy="choose another file, in a folder that exists and may be written, on a disk with space left",
    )  # fmt: skip
