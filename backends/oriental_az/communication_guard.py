"""The drive stops by itself when the host dies: its communication time-out, and what keeps it from running out.

Parameter 138Ah, "Communication timeout (Modbus)", in ms; 0 is off, 10 s the most (Oriental Motor HP-5142E). The drive
keeps what is written here until it is switched off.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from microdrivers.backends.oriental_az.drive import AzDrive
from microdrivers.core.clock import Clock, Timer
from microdrivers.core.errors import MicrodriversError, RefusedError
from microdrivers.core.units import seconds_to_ns

COMMUNICATION_TIMEOUT = 0x138A

BEATS = 5
"""In each time-out. The drive is asked at every second beat, so it hears something at 0.4 of the time-out."""

_MS_PER_S = 1000

_log = logging.getLogger(__name__)


class CommunicationGuard:
    """Sets the drive's communication time-out, and speaks to the drive when nobody else does.

    Args:
        wanted_s: what to set; None leaves the drive as it is, and speaks to it if it watches the host of its own.
        exchanges: how many exchanges there have been.
        ask: has one exchange with the drive; must not raise if the link fails.
    """

    def __init__(
        self,
        drive: AzDrive,
        *,
        wanted_s: float | None,
        clock: Clock,
        exchanges: Callable[[], int],
        ask: Callable[[], object],
    ) -> None:
        self._drive = drive
        self._wanted_s = wanted_s
        self._clock = clock
        self._exchanges = exchanges
        self._ask = ask
        self._heard = 0
        self._timer: Timer | None = None
        self._armed = False
        self._in_doubt = False

    def arm(self) -> None:
        """Find out or set the drive's time-out.

        Raises:
            RefusedError: the drive did not take it.
            DeviceFault, LinkError: as from any exchange.
        """
        if self._wanted_s is not None:
            self._armed = True  # first: if the reply fails, it may be set all the same
            self._set(round(self._wanted_s * _MS_PER_S))
        self._drive.communication_timeout_s = self._drive.read_value(COMMUNICATION_TIMEOUT) / _MS_PER_S

    def keep_armed(self, *, may_be_forgotten: bool) -> None:
        """Set the drive's time-out again if the drive may have been switched off and on.

        Raises:
            RefusedError, DeviceFault, LinkError: as for `arm`; the next call tries again.
        """
        self._in_doubt = self._armed and (self._in_doubt or may_be_forgotten)
        if self._in_doubt and self._wanted_s is not None:
            self._set(round(self._wanted_s * _MS_PER_S))
            self._in_doubt = False

    def start(self, *, name: str) -> None:
        """From here on the drive hears from this host; `name` is the timer's."""
        timeout_s = self._drive.communication_timeout_s
        if timeout_s <= 0:
            return
        period_s = timeout_s / BEATS
        self._heard = self._exchanges()
        self._timer = self._clock.every(
            period_s, self._beat, start_ns=self._clock.now_ns() + seconds_to_ns(period_s), name=name
        )

    def end(self) -> None:
        """Speak no more, and take back what `arm` has set, as the drive would stop with an alarm otherwise."""
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()
        armed, self._armed = self._armed, False
        self._drive.communication_timeout_s = 0.0
        if armed:
            try:
                self._drive.write_value(COMMUNICATION_TIMEOUT, 0)
            except MicrodriversError as error:
                _log.info("the drive's communication time-out could not be taken back: %s", error)

    def _set(self, wanted_ms: int) -> None:
        self._drive.write_value(COMMUNICATION_TIMEOUT, wanted_ms)
        held_ms = self._drive.read_value(COMMUNICATION_TIMEOUT)
        if held_ms != wanted_ms:
            raise RefusedError(
                f"the drive was given a communication time-out of {wanted_ms} ms and has {held_ms} ms",
                remedy="close the maker's software; check the drive's parameter 1392h (slave error response mode), or "
                "remove communication_timeout_s from the rig file",
            )

    def _beat(self) -> None:
        heard, self._heard = self._heard, self._exchanges()
        if heard == self._heard:
            self._ask()
