"""Takes a tool away from what it presses on, once it has been stopped."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from microdrivers.core.clock import Clock, Timer
from microdrivers.core.errors import BusyError, LinkError, MicrodriversError, MoveSuperseded
from microdrivers.core.samples import FineStageSample
from microdrivers.core.units import seconds_to_ns
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.motion import Move

_STEP_S = 0.02
_PATIENCE_S = 3.0
"""How long others may take to end what they were about to command."""

_GIVEN_UP = "given up, since the rig is being closed"

_log = logging.getLogger(__name__)


class Retraction:
    """`FineStage.retract()`, step by step on the clock, since whoever publishes a force must not wait.

    In real time the clock calls from a thread of its own; on a simulated clock it does whenever the main program waits,
    and each step exchanges on local time (docs/decisions/0003). It begins when nobody is about to command the stage any
    more, and is watched until the stage has settled.

    Args:
        stage: what carries the tool; asked for each time, since a rig may be given another driver.
        clock: of the rig.
        ended: told what became of it, and whether it has succeeded.
    """

    def __init__(self, stage: Callable[[], FineStage], *, clock: Clock, ended: Callable[[str, bool], object]) -> None:
        self._stage = stage
        self._clock = clock
        self._tell = ended
        self._lock = threading.Lock()
        self._finished = clock.event()
        self._timer: Timer | None = None
        self._move: Move[FineStageSample] | None = None
        self._patience_ns = 0
        self._took_away_ns: int | None = None
        self._closed = False
        self.active = False

    @property
    def took_away(self) -> bool:
        """Whether this has taken the tool away, and nothing has been commanded since."""
        return self._took_away_ns is not None and self._took_away_ns == self._stage().commanded_ns

    def begin(self) -> None:
        """Start it, from any thread or callback; nothing is awaited."""
        with self._lock:
            if self.active or self._closed:
                return
            self.active = True
        self._move = None
        self._finished.clear()
        now_ns = self._clock.now_ns()
        self._patience_ns = now_ns + seconds_to_ns(_PATIENCE_S)
        self._timer = self._clock.every(_STEP_S, self._step, start_ns=now_ns, name="retraction")

    def finish(self, timeout_s: float) -> bool:
        """Wait until it has ended, if it is under way; tells whether it is over."""
        return not self.active or self._finished.wait(timeout_s)

    def disarm(self) -> None:
        """None begins any more. One under way goes on until somebody stops the stage."""
        self._closed = True

    def close(self) -> None:
        """Give up what is under way, which somebody has stopped."""
        self.disarm()
        self._end(_GIVEN_UP, succeeded=False)

    def _step(self) -> None:
        timer = self._timer
        if not self.active:
            if timer is not None:  # it ended before this was known
                timer.cancel()
            return
        try:
            self._advance()
        except MicrodriversError as error:
            self._end(f"it failed: {error.what}", succeeded=False)

    def _advance(self) -> None:
        stage, patient = self._stage(), self._clock.now_ns() < self._patience_ns
        if self._move is None:
            if self._closed:
                self._end(_GIVEN_UP, succeeded=False)
                return
            if patient and stage.being_commanded:
                return
            try:
                self._move = stage.retract()
            except BusyError:
                if not patient:
                    raise
            return
        try:
            pose = self._move.look()
        except MoveSuperseded:  # nothing but a retraction is let through now
            self._end("somebody else's retract() has replaced it", succeeded=True)
            return
        except LinkError as error:
            if self._clock.now_ns() >= self._move.deadline_t_ns:
                raise
            _log.debug("retraction: %s", error)
            return
        if pose is not None:
            where = ", ".join(f"{axis} {position:.2f} µm" for axis, position in pose.position.items())
            share = stage.retraction_share
            self._took_away_ns = stage.commanded_ns if share > 0.0 else None
            part = "" if share == 1.0 else f" by {100 * share:.0f} % of retract_um, for no more is free"
            self._end(f"the tool was taken away{part}, to {where}", succeeded=share > 0.0)

    def _end(self, what: str, *, succeeded: bool) -> None:
        with self._lock:
            if not self.active:
                return
            self.active = False
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()
        self._tell(what, succeeded)
        self._finished.set()
