"""The form of GCS 2.0 replies, PI MS249E, pp. 115-117 and 126-127. Pure functions on bytes and text.

One reply is one or more lines; every line but its last ends in space and line feed, the last in a bare line
feed. Several replies may follow each other when their requests were sent in one write.

All functions raise `ProtocolError`, and nothing else, for what GCS does not allow.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

from microdrivers.core.errors import ProtocolError

_NUMBER = re.compile(r"[+-]?(\d{1,40}(\.\d{0,40})?|\.\d{1,40})([eE][+-]?\d{1,4})?", re.ASCII)
_INTEGER = re.compile(r"[+-]?\d{1,9}", re.ASCII)
_STATUS = re.compile(r"0[xX]((?:[0-9A-Fa-f]{4})+)", re.ASCII)
_ASSIGNMENT = re.compile(r"([A-Za-z0-9_]{1,16})=(.*)", re.ASCII)
_ADDRESSED = re.compile(r"(\d{1,3}) (\d{1,3}) (.*)", re.ASCII)
_PRINTABLE = re.compile(r"[\x20-\x7e\xa0-\xff\n]*")

ValueT = TypeVar("ValueT")

Reply = Sequence[str]
"""The lines of one reply, without their ends."""


class AxisStatus(NamedTuple):
    """The status register of one axis, as `#4` reports it."""

    on_target: bool
    referencing: bool
    moving: bool
    servo_on: bool
    error_flag: bool

    @classmethod
    def from_word(cls, word: int) -> AxisStatus:
        """Bits 15, 14, 13, 12 and 8 of the register."""
        return cls(word & 0x8000 > 0, word & 0x4000 > 0, word & 0x2000 > 0, word & 0x1000 > 0, word & 0x0100 > 0)


def completed_after(count: int) -> Callable[[bytes], bool]:
    """A test that tells whether `count` whole replies have arrived."""
    return lambda received: received.count(b"\n") - received.count(b" \n") >= count


def split_replies(received: bytes, count: int) -> list[Reply]:
    """Take exactly `count` whole replies apart.

    Raises:
        ProtocolError: another number of replies, an incomplete one, or bytes that are no text.
    """
    if not received.endswith(b"\n") or received.count(b"\n") - received.count(b" \n") != count:
        raise ProtocolError(f"{count} whole replies were expected")
    text = received.decode("latin-1")
    if not _PRINTABLE.fullmatch(text):
        raise ProtocolError("the reply is no text")
    replies: list[Reply] = []
    lines: list[str] = []
    for line in text.removesuffix("\n").split("\n"):
        lines.append(line.removesuffix(" "))
        if not line.endswith(" "):
            replies.append(lines)
            lines = []
    return replies


def without_address(reply: Reply, address: int) -> Reply:
    """A reply in a daisy chain without `0` and the sender's address, which stand before its first line only.

    Raises:
        ProtocolError: there is none, or it is another controller's.
    """
    match = _ADDRESSED.fullmatch(reply[0])
    if match is None:
        raise ProtocolError(
            f"no address is in front of it, where '0 {address} ' was expected",
            remedy="check that this is a GCS 2.0 controller in a daisy chain; without a chain, give no address",
        )
    to, sender = int(match[1]), int(match[2])
    if (to, sender) != (0, address):
        raise ProtocolError(
            f"address {address} was asked, and the answer is from address {sender} to {to}",
            remedy="check that DIP switches 1-4 give each controller of the chain an address of its own, and that "
            "nothing else uses this line",
        )
    return [match[3], *reply[1:]]


def single(reply: Reply) -> str:
    """The text of a reply of one line."""
    if len(reply) != 1:
        raise ProtocolError(f"one line was expected, not {len(reply)}")
    return reply[0].strip()


def assignments(reply: Reply, convert: Callable[[str], ValueT]) -> dict[str, ValueT]:
    """Lines of the form `axis=value`, by axis."""
    values: dict[str, ValueT] = {}
    for line in reply:
        match = _ASSIGNMENT.fullmatch(line.strip())
        if match is None:
            raise ProtocolError(f"'axis=value' was expected, not {line[:40]!r}")
        axis, text = match.groups()
        if axis in values:
            raise ProtocolError(f"axis {axis} is reported twice")
        values[axis] = convert(text.strip())
    return values


def number(text: str) -> float:
    """A finite number in plain or exponential notation; a leading plus is allowed."""
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise ProtocolError(f"a number was expected, not {text[:40]!r}")
    return value


def flag(text: str) -> bool:
    """0 or 1."""
    if text not in ("0", "1"):
        raise ProtocolError(f"0 or 1 was expected, not {text[:40]!r}")
    return text == "1"


def integer(text: str) -> int:
    """A decimal integer."""
    if not _INTEGER.fullmatch(text):
        raise ProtocolError(f"an integer was expected, not {text[:40]!r}")
    return int(text)


def status(text: str) -> tuple[AxisStatus, ...]:
    """`0x` and four hexadecimal digits for each axis."""
    match = _STATUS.fullmatch(text)
    if match is None:
        raise ProtocolError(f"a status register was expected, not {text[:40]!r}")
    digits = match.group(1)
    return tuple(AxisStatus.from_word(int(digits[i : i + 4], 16)) for i in range(0, len(digits), 4))


def decimal(value: float) -> str:
    """A number for a request: rounded to seven decimals, plain notation, no more bytes than needed."""
    text = f"{value:.7f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
