"""Reads the parts of a multipart/x-mixed-replace stream (RFC 2046, section 5.1) one after the other."""

from __future__ import annotations

from email.message import Message
from email.parser import BytesParser
from email.policy import compat32
from typing import Protocol

from microdrivers.core.errors import LinkLost, ProtocolError

MAX_PART_BYTES = 256 * 1024 * 1024
_MAX_LINE_BYTES = 65536
_MAX_HEADER_LINES = 64
_ENDED = "the stream ended"
_REMEDY = "check that the server still runs, then close and open the camera again"


class ByteStream(Protocol):
    """What is read: a buffered stream of bytes."""

    def readline(self, limit: int, /) -> bytes:
        """Up to and including the next line end."""

    def read(self, length: int, /) -> bytes:
        """Exactly so many bytes, or fewer at the end."""


class MultipartReader:
    """Splits a stream at its boundary.

    Parts with Content-Length are read in one go; without it, up to the next boundary.
    """

    def __init__(self, stream: ByteStream, boundary: str) -> None:
        self._stream = stream
        # Some servers write the dashes into the parameter already.
        self._delimiter = b"--" + boundary.encode("latin-1").removeprefix(b"--")
        self._at_headers = False

    def next_headers(self) -> Message:
        """Wait for the next part and read its headers.

        Raises:
            LinkLost: the stream ended or failed. ProtocolError: what comes is no multipart stream.
        """
        skipped = 0
        while not self._at_headers:
            line = self._line()
            self._at_headers = line.startswith(self._delimiter)
            skipped += len(line)
            if skipped > MAX_PART_BYTES:
                raise ProtocolError("the stream has no boundary", received=line[:64])
        self._at_headers = False
        lines: list[bytes] = []
        while (line := self._line()).strip():
            lines.append(line)
            if len(lines) > _MAX_HEADER_LINES:
                raise ProtocolError("a part's headers have no end", received=line[:64])
        return BytesParser(policy=compat32).parsebytes(b"".join(lines), headersonly=True)

    def body(self, headers: Message) -> bytes:
        """The body that follows these headers."""
        stated = headers.get("Content-Length")
        if stated is None:
            return self._until_boundary()
        if not stated.strip().isdecimal() or int(stated) > MAX_PART_BYTES:
            raise ProtocolError(f"a part states an impossible length of {stated[:32]!r} bytes")
        body = self._read(int(stated))
        if len(body) < int(stated):
            raise LinkLost(f"{_ENDED} inside a frame", remedy=_REMEDY, moved="no")
        return body

    def _until_boundary(self) -> bytes:
        body = bytearray()
        while not (line := self._line()).startswith(self._delimiter):
            body += line
            if len(body) > MAX_PART_BYTES:
                raise ProtocolError("a part has no end", received=bytes(body[:64]))
        self._at_headers = True
        return bytes(body.removesuffix(b"\r\n"))

    def _line(self) -> bytes:
        try:
            line = self._stream.readline(_MAX_LINE_BYTES)
        except (OSError, ValueError) as error:  # ValueError: closed by another thread
            raise LinkLost(f"the stream failed: {error}", remedy=_REMEDY, moved="no") from error
        if not line:
            raise LinkLost(_ENDED, remedy=_REMEDY, moved="no")
        return line

    def _read(self, length: int) -> bytes:
        try:
            return self._stream.read(length)
        except (OSError, ValueError) as error:
            raise LinkLost(f"the stream failed: {error}", remedy=_REMEDY, moved="no") from error
