"""What an amplifier's TPDO brings: value, flags and the instant of the measurement, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from microdrivers.backends.canopen.pdo import tpdo_id
from microdrivers.backends.canopen.synced_pdos import SyncedPdos, SyncSet
from microdrivers.backends.cia404.measurement_frame import MeasurementFrame, frame_time
from microdrivers.backends.cia404.settings import Cia404ForceSettings
from microdrivers.backends.lines.can_line import CanLine, Listening, Received
from microdrivers.core.units import NS_PER_MS, NS_PER_S

_LONGEST_FRAME_BYTES = 8

_FOLLOW = 0.05
"""How much of what is no whole period is put down to the amplifier's own clock, a frame."""


class Measurement(NamedTuple):
    """Raw force and flags, and the interval in which it was made: `t_ns` ± `dt_ns` on the rig's clock."""

    raw_uN: float
    flags: frozenset[str]
    t_ns: int
    dt_ns: int


class MeasurementStream:
    """The TPDOs of one amplifier.

    A value is up to one conversion old when its frame is made, and the frame may wait while one other passes on the
    bus. With SYNC, the interval begins one conversion before the SYNC and ends when it has reached the node.

    Args:
        frame: what the TPDO carries.
        on_measurement: called with each, in the thread that receives.

    Attributes:
        lost: frames that should have come since `begin` and did not.
        odd: frames that have another length: somebody else sends under that identifier.
        heard_ns: when the newest frame was handed over, on the rig's clock.
    """

    def __init__(
        self,
        line: CanLine,
        settings: Cia404ForceSettings,
        frame: MeasurementFrame,
        on_measurement: Callable[[Measurement], object],
    ) -> None:
        self.lost = 0
        self.odd = 0
        self.heard_ns = 0
        self._line = line
        self._now_ns = line.clock.now_ns
        self._settings = settings
        self._decode = frame.decode
        self._length = frame.length
        self._on_measurement = on_measurement
        self._cob_id = tpdo_id(settings.node_id)
        self._conversion_half_ns = round(settings.conversion_ms * NS_PER_MS / 2)
        bitrate = settings.connection.bitrate
        own, other = frame_time(frame.length, bitrate=bitrate), frame_time(_LONGEST_FRAME_BYTES, bitrate=bitrate)
        waiting_half_ns = (other.ns + other.half_width_ns) // 2
        self._age_ns = own.ns + waiting_half_ns + self._conversion_half_ns
        self._age_half_ns = own.half_width_ns + waiting_half_ns + self._conversion_half_ns
        self._period_ns = 0
        self._newest_ns = 0
        self._behind = 0.0
        self._synced: SyncedPdos | None = None
        self._ends: list[Callable[[], object]] = []

    def begin(self, rate_hz: float) -> None:
        """Take what comes, at this rate; with SYNC, ask for it."""
        self.lost = 0
        self.heard_ns = self._now_ns()
        self._newest_ns = 0
        self._behind = 0.0
        self._period_ns = round(NS_PER_S / rate_hz)
        if not self._settings.sync:
            self._end_with(self._line.listen(self._cob_id, self._hear))
            return
        synced = SyncedPdos(self._line, (self._cob_id,), on_set=self._hear_set, on_lost=self._hear_nothing)
        self._synced = synced
        synced.begin_listening()
        self._ends.append(synced.end_listening)
        self._end_with(synced.run(rate_hz))

    def end(self) -> None:
        """Take no more; idempotent."""
        while self._ends:
            self._ends.pop()()

    def take(self, timeout_s: float) -> Measurement | None:
        """With SYNC, a measurement now; None without it.

        Raises:
            LinkTimeout: the amplifier is silent. LinkLost: the adapter is gone.
        """
        return None if self._synced is None else self._of_set(self._synced.take(timeout_s))

    def _end_with(self, listening: Listening) -> None:
        self._ends.append(listening.cancel)

    # ------------------------------------------------------------------ frames

    def _hear(self, received: Received) -> None:
        data, t_ns = received.data, received.t_ns
        if len(data) != self._length:
            self.odd += 1
            return
        self.heard_ns = self._now_ns()
        if self._newest_ns:
            self._count_missing(t_ns - self._newest_ns)
        self._newest_ns = t_ns
        raw_uN, flags = self._decode(data)
        dt_ns = received.dt_ns + self._age_half_ns
        self._on_measurement(Measurement(raw_uN, flags, t_ns - self._age_ns, dt_ns))

    def _count_missing(self, gap_ns: int) -> None:
        """How many periods the frames are behind their timer: whole ones are losses, the rest waited for the bus.

        A late frame counts as lost until those behind it, which come early then, make up for it.
        """
        behind = self._behind + gap_ns / self._period_ns - 1.0
        missing = round(behind)
        if missing < 0:  # the count began with a late frame
            behind, missing = behind - missing, 0
        self.lost = missing
        self._behind = behind + _FOLLOW * (missing - behind)

    def _hear_set(self, answers: SyncSet) -> None:
        measurement = self._of_set(answers)
        if measurement is not None:
            self.heard_ns = self._now_ns()
            self._on_measurement(measurement)

    def _of_set(self, answers: SyncSet) -> Measurement | None:
        data = answers.frames[0].data
        if len(data) != self._length:
            self.odd += 1
            return None
        half_ns = self._conversion_half_ns
        return Measurement(*self._decode(data), answers.t_ns - half_ns, answers.dt_ns + half_ns)

    def _hear_nothing(self, _missing: Sequence[int]) -> None:
        self.lost += 1
