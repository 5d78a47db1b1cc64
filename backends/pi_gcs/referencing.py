"""Finding the reference of an axis: at its reference switch (FRF) or at a limit switch (FNL, FPL)."""

from __future__ import annotations

from collections.abc import Callable

from microdrivers.backends.pi_gcs import error_codes
from microdrivers.backends.pi_gcs.controller import Controller
from microdrivers.core.clock import Clock
from microdrivers.core.errors import DeviceFault, MicrodriversError, MoveCancelled, NotReached, UnsupportedError
from microdrivers.core.units import seconds_to_ns

_POLL_S = 0.05


class ReferenceSearch:
    """The search for the reference of one axis.

    Args:
        controller: the one that drives the axis.
        axis: x, y or theta.
        clock: to wait on.
        timeout_s: how long the search may take.
        stop: stops the whole stage; is told by whom and why.
    """

    def __init__(
        self, controller: Controller, axis: str, *, clock: Clock, timeout_s: float, stop: Callable[[str, str], None]
    ) -> None:
        self._controller = controller
        self._gcs = controller.gcs
        self._axis = axis
        self._map = controller.axes[axis]
        self._clock = clock
        self._timeout_s = timeout_s
        self._stop = stop

    def run(self) -> None:
        """Move the axis to its switch and return when the controller knows its reference.

        Raises:
            DeviceFault: the axis is at fault, or has not found its reference.
            UnsupportedError: it has no such switch.
            MoveCancelled: it was stopped. NotReached: it took too long, and was stopped.
        """
        controller, axis = self._controller, self._axis
        with controller.naming_errors([axis]):
            controller.refuse_at_fault([axis])
            stops = self._gcs.stops
            controller.state.begin_reference(axis)
            controller.forget_targets([axis])
            try:
                self._gcs.command(f"SVO {self._map.id} 1")
                self._gcs.command(f"RON {self._map.id} 1")
                self._begin(f"{self._map.reference} {self._map.id}", stops)
                self._await_ready(stops)
                code = controller.examine()
            finally:
                controller.state.end_reference()
            if self._gcs.stops != stops or code == error_codes.STOPPED:
                raise self._stopped()
            if not controller.state.referenced[axis]:
                raise DeviceFault(
                    f"axis {axis} has not found its reference ({self._map.reference}); error {code}",
                    code=code or error_codes.REFERENCING_FAILED, text="referencing failed",
                    remedy="check the switches, the way, and `reference` of the axis in the rig file",
                )  # fmt: skip

    def _begin(self, line: str, stops: int) -> None:
        if self._gcs.stops != stops:
            raise self._stopped()
        try:
            code = self._gcs.attempt(line)
        finally:
            if self._gcs.stops != stops:
                self._stop("driver", "the stop may have come before the command to search the reference")
        if code == error_codes.MOVE_NOT_ALLOWED:
            raise DeviceFault(
                f"the controller does not start the reference move of axis {self._axis}: its servo is off",
                code=code, text=error_codes.meaning_of(code), moved="no",
                remedy="check the motor supply, the emergency stop and the stage cable",
            )  # fmt: skip
        if code:
            raise self._refusal(code, line)

    def _refusal(self, code: int, line: str) -> MicrodriversError:
        refusal = self._gcs.refusal(code, line)
        if isinstance(refusal, UnsupportedError):
            others = " or ".join(mode for mode in ("FRF", "FNL", "FPL") if mode != self._map.reference)
            refusal.remedy = f"give axis {self._axis} another `reference` in the rig file: {others}"
        return refusal

    def _await_ready(self, stops: int) -> None:
        """Wait until the reference move has ended, well or not."""
        deadline_ns = self._clock.now_ns() + seconds_to_ns(self._timeout_s)
        while not self._gcs.ready():
            if self._gcs.stops != stops:
                raise self._stopped()
            if self._clock.now_ns() >= deadline_ns:
                self._stop("supervision", f"axis {self._axis} did not find its reference")
                raise NotReached(
                    f"axis {self._axis} has not found its reference in {self._timeout_s:g} s; stopped",
                    remedy="check the switches and the way, or allow more reference_timeout_s in the rig file",
                )
            self._clock.sleep(_POLL_S)

    def _stopped(self) -> MoveCancelled:
        return MoveCancelled(
            f"the reference move of axis {self._axis} was stopped",
            remedy=f"check why the stop was requested, then reference([{self._axis!r}])",
        )
