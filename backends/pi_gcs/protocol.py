"""The command language PI GCS 2.0 over a serial line: requests, replies, typed errors.

Set commands have no reply, so each is followed by `ERR?` in the same write: one exchange, and the error
number belongs to the command. A set command is never repeated. A query changes nothing and is repeated once
if its reply did not come (not `ERR?`: reading it clears it). `MVR` is never used: a relative move whose reply
is lost has no known end.

In a daisy chain every request begins with the address of the controller that it is for, and the first line of
every reply with `0` (the host) and the address that it comes from. Single bytes are then sent in a line of their own.
Only one controller is asked at a time, so that an answer of another one is always a late or a misplaced one.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

from microdrivers.backends.lines.serial_line import Exchange, SerialLine
from microdrivers.backends.pi_gcs import error_codes, replies
from microdrivers.core.errors import LinkError, LinkTimeout, MicrodriversError, MoveCancelled, ProtocolError

STATUS_REGISTER = "\x04"
REQUEST_READY = "\x07"
STOP_ALL = "\x18"

_READY = {"\xb1": True, "\xb0": False}
_SINGLE_BYTE = (STATUS_REGISTER, REQUEST_READY, STOP_ALL)
_POSITIONS = "POS?"
_TWO_REPLIES = replies.completed_after(2)

UNINTELLIGIBLE_REMEDY = (
    "check the baud rate (a wrong one gives garbage or silence), the cable, and that nothing else uses this line"
)

ResultT = TypeVar("ResultT")

_log = logging.getLogger(__name__)


class Pose(NamedTuple):
    """Positions and status registers, asked for in one write.

    `positions` are in the controller's units (mm, deg) by axis id, `status` is in the order of its axes. The
    times are ns on the rig's clock: when the write began, when the last bit of `POS?` had left, when the first byte
    of the reply was seen, and the last.
    """

    positions: dict[str, float]
    status: tuple[replies.AxisStatus, ...]
    start_ns: int
    asked_ns: int
    first_byte_ns: int
    end_ns: int


class Gcs:
    """One GCS 2.0 controller at the end of a line, which it does not open or close.

    Args:
        address: of the controller in a daisy chain, 1 to 16; None if it has the line to itself.

    Attributes:
        identity: the answer to `*IDN?`, once `identify()` has been called.
        interruptions: how many exchanges have failed; whoever sees it change should doubt what he knew.
        stops: changes whenever a stop is sent.
        neighbours: the other controllers on the same line.
        pose_asked_after_ns: from the start of the request for a pose until the last bit of `POS?` has left.
    """

    def __init__(self, line: SerialLine, *, address: int | None = None) -> None:
        self.address = address
        self.identity = ""
        self.interruptions = 0
        self.stops = 0
        self.neighbours: Sequence[Gcs] = ()
        self._line = line
        self._pose_request = self.request(_POSITIONS, STATUS_REGISTER)
        self.pose_asked_after_ns = len(self.request(_POSITIONS)) * line.byte_ns
        self._stop_numbers = itertools.count(1)
        self._error_pending = False
        self._suspect = False

    def request(self, *commands: str) -> bytes:
        """These commands as they go on the line."""
        if self.address is not None:
            lines = (f"{self.address} {command}\n" for command in commands)
        else:
            lines = (command if command in _SINGLE_BYTE else f"{command}\n" for command in commands)
        return "".join(lines).encode("ascii")

    # ------------------------------------------------------------------ queries

    def identify(self) -> str:
        """The answer to `*IDN?`, which from now on tells this controller's replies from late ones.

        Raises:
            LinkTimeout, ProtocolError: silence, or garbage.
        """
        self.identity, self._suspect, self._error_pending = "", False, False
        self.identity = self._query("*IDN?", replies.single)
        return self.identity

    def names(self, command: str) -> list[str]:
        """A reply that lists one name a line, as `SAI?` does."""
        return self._query(command, lambda reply: [line.strip() for line in reply])

    def texts(self, command: str) -> dict[str, str]:
        """A text for each axis, as `CST?` gives."""
        return self._query(command, lambda reply: replies.assignments(reply, str))

    def numbers(self, command: str) -> dict[str, float]:
        """A number for each axis, in the controller's units."""
        return self._query(command, lambda reply: replies.assignments(reply, replies.number))

    def flags(self, command: str) -> dict[str, bool]:
        """Yes or no for each axis."""
        return self._query(command, lambda reply: replies.assignments(reply, replies.flag))

    def status(self) -> tuple[replies.AxisStatus, ...]:
        """The status registers of all axes (#4)."""
        return self._query(STATUS_REGISTER, lambda reply: replies.status(replies.single(reply)))

    def ready(self) -> bool:
        """Whether the controller can take any command (#7); it cannot while it references."""
        return self._query(REQUEST_READY, _ready)

    def pose(self) -> Pose:
        """Positions and status in one write, so that they belong together."""
        return self.understand_pose(self.ask_pose())

    def ask_pose(self) -> Exchange:
        """The exchange that holds a pose, as yet not understood."""
        try:
            return self._exchange(self._pose_request, _TWO_REPLIES)
        except LinkTimeout as silence:
            self._explain(silence, self._pose_request)
        return self._exchange(self._pose_request, _TWO_REPLIES)

    def understand_pose(self, exchange: Exchange) -> Pose:
        """The pose in an exchange."""
        positions, status = self._understand(exchange, self._pose_request, 2, _positions_and_status)
        start_ns = exchange.request_start_ns
        asked_ns = start_ns + self.pose_asked_after_ns
        return Pose(positions, status, start_ns, asked_ns, exchange.first_byte_ns, exchange.end_ns)

    def error(self) -> int:
        """The controller's last error number, which this clears. Never repeated."""
        self._error_pending = False
        return self._ask(self.request("ERR?"), 1, _error_code)

    # ------------------------------------------------------------------ commands

    def command(self, *lines: str) -> None:
        """Send set commands in one write and raise what the controller says about them.

        Raises:
            MicrodriversError: see `error_codes`. MoveCancelled: a stop was sent meanwhile.
        """
        code = self.attempt(*lines)
        if code:
            raise self.refusal(code, *lines)

    def refusal(self, code: int, *lines: str) -> MicrodriversError:
        """What the controller's error number says about these commands, ready to be raised."""
        return error_codes.error_from(code, sent=self.request(*lines))

    def attempt(self, *lines: str) -> int:
        """As `command`, but return the error number (0 if none) of the last line that failed.

        A stop that was sent earlier has left error 10 in the controller, and a failed exchange may have left
        any other: it is read away in the same write, so that it is not taken for this command's.
        """
        stops, stale = self.stops, self._error_pending
        self._error_pending = False
        request = self.request(*(["ERR?"] if stale else []), *lines, "ERR?")
        codes: list[int] = self._ask(request, 1 + stale, lambda *found: [_error_code(reply) for reply in found])
        if stale and codes[0] not in (error_codes.NO_ERROR, error_codes.STOPPED):
            _log.warning("an earlier error %d (%s) was pending", codes[0], error_codes.meaning_of(codes[0]))
        if self.stops != stops:
            raise MoveCancelled(
                f"a stop was sent while {self.request(*lines)!r} was under way",
                remedy="check why the stop was requested, read the position, then command a new move",
                moved="maybe",
            )
        return codes[-1]

    def stop(self) -> None:
        """Stop all axes of all controllers on the line abruptly (#24), in one write.

        From any thread, past an exchange under way, awaiting nothing.
        """
        # HLT is not used, neither here nor for one controller of a chain: it is a line among others, which a controller
        # works off in its turn, while #24 is served at once, also during a reference move, and needs no axis. Its line
        # feed in a chain leaves nothing in any controller's buffer that could spoil the next request.
        controllers = (self, *self.neighbours)
        # Before and after: whoever begins or ends an exchange while this is sent must notice it.
        for gcs in controllers:
            gcs._note_stop()
        try:
            self._line.send_now(b"".join(gcs.request(STOP_ALL) for gcs in controllers))
        finally:
            for gcs in controllers:
                gcs._note_stop()

    def leave(self) -> None:
        """Read away the error that our own stop has left, or the next program takes it for its own (pipython does)."""
        if self.identity and self._error_pending and not self._suspect:
            with contextlib.suppress(LinkError):
                self.error()

    # ------------------------------------------------------------------ inside

    def _note_stop(self) -> None:
        self.stops = next(self._stop_numbers)
        self._error_pending = True

    def _query(self, command: str, parse: Callable[[replies.Reply], ResultT]) -> ResultT:
        request = self.request(command)
        return self._patiently(lambda request: self._ask(request, 1, parse), request)

    def _patiently(self, ask: Callable[[bytes], ResultT], request: bytes) -> ResultT:
        """Ask; if no answer comes find out why, and if the controller does not know either, ask once more."""
        try:
            return ask(request)
        except LinkTimeout as silence:
            self._explain(silence, request)
        return ask(request)

    def _explain(self, silence: LinkTimeout, request: bytes) -> None:
        """A refused query has no reply; its reason waits in ERR?."""
        if not self.identity:
            return
        try:
            code = self.error()
        except LinkTimeout:
            raise silence from None
        if code not in (error_codes.NO_ERROR, error_codes.STOPPED):
            raise error_codes.error_from(code, sent=request) from silence

    def _ask(self, request: bytes, count: int, parse: Callable[..., ResultT]) -> ResultT:
        """One exchange whose reply consists of `count` GCS replies, which `parse` is given."""
        return self._understand(self._exchange(request, replies.completed_after(count)), request, count, parse)

    def _exchange(self, request: bytes, complete: Callable[[bytes], bool]) -> Exchange:
        try:
            if self._suspect:
                self._resynchronise()
            return self._line.exchange(request, complete)
        except LinkError:
            self._interrupted()
            raise

    def _understand(self, exchange: Exchange, request: bytes, count: int, parse: Callable[..., ResultT]) -> ResultT:
        try:
            found = replies.split_replies(exchange.reply, count)
            if self.address is not None:
                found = [replies.without_address(reply, self.address) for reply in found]
            return parse(*found)
        except ProtocolError as error:
            self._interrupted()
            raise ProtocolError(
                f"unintelligible reply: {error.what}",
                sent=request, received=exchange.reply, remedy=error.remedy or UNINTELLIGIBLE_REMEDY,
            ) from None  # fmt: skip

    def _resynchronise(self) -> None:
        """Ask for the identity and read until it comes: what comes before it answers earlier requests."""
        if self.identity:
            sender = "" if self.address is None else f"0 {self.address} "
            last_line = f"{sender}{self.identity}\n".encode("latin-1")
            self._line.exchange(self.request("*IDN?"), lambda received: received.endswith(last_line))
        self._suspect = False

    def _interrupted(self) -> None:
        self.interruptions += 1
        self._suspect = self._error_pending = True
        for gcs in self.neighbours:  # what is still on its way would come when they are asked
            gcs._suspect = True


def _ready(reply: replies.Reply) -> bool:
    text = replies.single(reply)
    if text not in _READY:
        raise ProtocolError(f"ready or not ready was expected, not {text[:40]!r}")
    return _READY[text]


def _positions_and_status(
    first: replies.Reply, second: replies.Reply
) -> tuple[dict[str, float], tuple[replies.AxisStatus, ...]]:
    # Controllers may serve a single byte at once, ahead of a line that is still being worked on.
    if first[0].startswith("0x"):
        first, second = second, first
    return replies.assignments(first, replies.number), replies.status(replies.single(second))


def _error_code(reply: replies.Reply) -> int:
    return replies.integer(replies.single(reply))
