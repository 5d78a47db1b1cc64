"""Why a file cannot be read as a recording."""

from __future__ import annotations

from microdrivers.core.errors import DataError


class RecordingError(DataError):
    """A recording cannot be read."""


class EmptyRecording(RecordingError):
    """The file is empty, or ends before its first complete record."""


class ForeignRecording(RecordingError):
    """The file is not MCAP, or MCAP that microdrivers did not write."""


class FutureRecording(RecordingError):
    """The file has a schema version that this version of microdrivers does not know yet."""
