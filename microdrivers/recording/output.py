"""The file that a recording is written to."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from microdrivers.core.errors import ConfigError
from microdrivers.recording.mcap_writer import Output


class OutputFile(Output, Protocol):
    """An output that can be closed."""

    def close(self) -> None:
        """No more is written."""


def create_file(file: Path) -> OutputFile:
    """A new, unbuffered file.

    Raises:
        ConfigError: it exists, or cannot be made.
    """
    try:
        return file.open("xb", buffering=0)
    except FileExistsError as error:
        raise ConfigError(
            "the file exists, and a recording is never written over", file=str(file),
            remedy="choose another name for the recording, or remove the file",
        ) from error  # fmt: skip
    except OSError as error:
        raise not_writable(file, error) from error


def not_writable(file: Path, error: OSError) -> ConfigError:
    """What to tell the user of a file that cannot be written."""
    return ConfigError(
        f"the recording cannot be written there: {error.strerror or error}", file=str(file),
        remedy="choose another file, in a folder that exists and may be written, on a disk with space left",
    )  # fmt: skip
