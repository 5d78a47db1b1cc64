"""The controller at its serial port: bytes to command lines, addresses, replies and their times."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from microdrivers.core.units import seconds_to_ns
from microdrivers.fakes.pi_gcs.codes import CommandError, ErrorCode
from microdrivers.fakes.pi_gcs.command_forms import Call
from microdrivers.fakes.pi_gcs.commands import run_command
from microdrivers.fakes.pi_gcs.state import ControllerState
from microdrivers.fakes.wire import Reply

REPLY_DELAY_S = (0.001, 0.003)
"""Shortest and longest time from a request's last byte to the reply's first."""
MAX_LINE_BYTES = 256
"""Longest command line without its line feed."""
FIRST_ADDRESS = 1
"""The controller with this address is meant, and answers without a prefix, where a line has no address."""
BROADCAST_ADDRESS = 255
"""All controllers on a line are meant, and none of them answers."""

_LINE_FEED = 0x0A
_NUMBER = re.compile(rb"\d{1,3}")


class _Header(NamedTuple):
    """Where a line goes to, and what the reply's first line begins with; without a prefix there is no reply."""

    address: int
    prefix: str | None


class GcsController:
    """Receives bytes and answers; implements `fakes.wire.WireEmulator`.

    A command is carried out at the instant at which its last byte arrives. Its reply leaves after a seeded
    delay within REPLY_DELAY_S, in the order of the requests. A new VEL, ACC or DEC holds from the next motion
    on.

    Args:
        address: its place on the line, 1 to 16; it ignores what is meant for others.
    """

    def __init__(self, state: ControllerState, *, seed: int, address: int = FIRST_ADDRESS) -> None:
        self.state = state
        self.address = address
        self._random = np.random.default_rng(seed)
        self._line = bytearray()
        self._too_long = False
        self._last_reply_ns = 0

    @property
    def events(self) -> list[tuple[int, str]]:
        """What concerned motion, as (t_ns, text); see `ControllerState`."""
        return self.state.events

    # ------------------------------------------------------------------ the wire's side

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        """Bytes arrive, evenly spaced; each acts at the instant at which it is complete."""
        replies = []
        for number, byte in enumerate(data, start=1):
            t_ns = start_ns + (end_ns - start_ns) * number // len(data)
            reply = self._take(byte, t_ns)
            if reply is not None:
                replies.append(reply)
        return replies

    def advance(self, t_ns: int) -> Sequence[Reply]:
        """Nothing is sent unasked; what has ended by itself is noted."""
        self.state.update(t_ns)
        return ()

    def next_event_ns(self) -> int | None:
        """Nothing happens without bytes that could not be worked out later."""
        return None

    def power_cycle(self, t_ns: int) -> None:
        """Switch off and on: servos off, references, settings and errors gone, encoders count from here."""
        self.state.update(t_ns)
        self.state.power_cycle(t_ns)
        self._line.clear()
        self._too_long = False

    def motion_error(self, key: str, t_ns: int) -> None:
        """Something holds the axis x, y or theta: the position error grows too large, the servo drops out."""
        self.state.update(t_ns)
        self.state.motion_error(key, t_ns)

    # ------------------------------------------------------------------ bytes

    def _take(self, byte: int, t_ns: int) -> Reply | None:
        if byte in _SINGLE_BYTES:
            return self._run_single_byte(byte, t_ns)
        if byte == _LINE_FEED:
            line, too_long = bytes(self._line), self._too_long
            self._line.clear()
            self._too_long = False
            return self._run_line(line, too_long, t_ns)
        if len(self._line) < MAX_LINE_BYTES:
            self._line.append(byte)
        else:
            self._too_long = True
        return None

    def _run_single_byte(self, byte: int, t_ns: int) -> Reply | None:
        header = self._take_begun_header()
        if not self._is_meant(header):
            return None
        self.state.update(t_ns)
        return self._reply(_SINGLE_BYTES[byte](self.state, t_ns), header.prefix, t_ns)

    def _take_begun_header(self) -> _Header:
        """An address in front of a single byte is its own, unless a command has begun behind it."""
        words = bytes(self._line).split()
        header = _take_header(words)
        if words or not self._line[-1:].isspace():
            return _Header(FIRST_ADDRESS, "")
        self._line.clear()
        return header

    def _run_line(self, line: bytes, too_long: bool, t_ns: int) -> Reply | None:
        words = line.split()
        header = _take_header(words)
        if not self._is_meant(header) or not words:
            return None
        self.state.update(t_ns)
        name, *arguments = (word.decode("latin-1") for word in words)
        try:
            if too_long:
                raise CommandError(ErrorCode.COMMAND_TOO_LONG)
            lines = run_command(name.upper(), Call(self.state, arguments, t_ns))
        except CommandError as error:
            self.state.error = error.code
            return None
        return self._reply(lines, header.prefix, t_ns)

    def _is_meant(self, header: _Header) -> bool:
        return header.address in (self.address, BROADCAST_ADDRESS)

    def _reply(self, lines: Sequence[str], prefix: str | None, t_ns: int) -> Reply | None:
        if not lines or prefix is None:
            return None
        delay_ns = max(seconds_to_ns(self._random.uniform(*REPLY_DELAY_S)), self.state.pose_latch_delay_ns)
        self._last_reply_ns = max(t_ns + delay_ns, self._last_reply_ns)
        text = prefix + " \n".join(lines) + "\n"
        return Reply(self._last_reply_ns, text.encode("latin-1", errors="replace"))


def _take_header(words: list[bytes]) -> _Header:
    """Remove "<to> [<from>]" from the beginning of a line."""
    numbers: list[int] = []
    while words and len(numbers) < 2 and _NUMBER.fullmatch(words[0]):
        numbers.append(int(words.pop(0)))
    if not numbers:
        return _Header(FIRST_ADDRESS, "")
    if numbers[0] == BROADCAST_ADDRESS:
        return _Header(BROADCAST_ADDRESS, None)
    sender = numbers[1] if len(numbers) > 1 else 0
    return _Header(numbers[0], f"{sender} {numbers[0]} ")


# ---------------------------------------------------------------------- single bytes


def _status(state: ControllerState, t_ns: int) -> list[str]:
    error = state.error is not ErrorCode.NONE
    return ["0x" + "".join(f"{axis.status_at(t_ns, error=error):04X}" for axis in state.channels.values())]


def _motion(state: ControllerState, t_ns: int) -> list[str]:
    moving = sum(axis.moving_at(t_ns) << n for n, axis in enumerate(state.channels.values()))
    return [f"{moving:X}"]


def _ready(state: ControllerState, _: int) -> list[str]:
    return ["\xb0" if any(axis.referencing for axis in state.channels.values()) else "\xb1"]


def _macro_running(_state: ControllerState, _t_ns: int) -> list[str]:
    return ["0"]


def _stop(state: ControllerState, t_ns: int) -> list[str]:
    state.stop_all(t_ns, "#24")
    return []


_SINGLE_BYTES: dict[int, Callable[[ControllerState, int], list[str]]] = {
    4: _status,
    5: _motion,
    7: _ready,
    8: _macro_running,
    24: _stop,
}
