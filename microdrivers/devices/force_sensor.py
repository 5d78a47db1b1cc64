"""Capacitive force sensors: raw and tared value kept apart, validity said with every sample."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager

import msgspec
import numpy as np

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.errors import LinkTimeout, RefusedError, SaturatedData
from microdrivers.core.samples import ForceSample, TimeSource
from microdrivers.core.units import NS_PER_S, Range, check_range
from microdrivers.devices.base import Device
from microdrivers.devices.force_sensor_settings import ForceSensorSettings
from microdrivers.devices.shared_stream import SharedStream

SATURATED, DISCONNECTED, STALE, UNTARED = "SATURATED", "DISCONNECTED", "STALE", "UNTARED"
INVALID = frozenset({SATURATED, DISCONNECTED, STALE})
_NOT_OF_A_SENSOR = frozenset({DISCONNECTED, STALE})

TARE_DURATIONS_S = Range(0.05, 60.0)
_FEWEST_READINGS = 8
_DRIFT_T = 4.0
"""A slope is drift if it is this many times its own standard deviation (p < 1e-4) and matters."""

Vector = tuple[float, float, float]


class Tare(msgspec.Struct, frozen=True, kw_only=True):
    """A zero that was taken: mean and standard deviation of `n` raw readings, at `t_ns`."""

    t_ns: int
    offset_uN: float
    sigma_uN: float
    n: int


class ForceSensor(Device[ForceSample]):
    """One axis of force, µN; two axes are two sensors.

    A driver supplies the hooks of `Device`, fills the attributes (`_adopt`), and makes its samples with `_sample`; one
    whose amplifier streams by itself also supplies `_stream_at`. Nothing is tared by itself. While a stream is open and
    no reading comes, samples without a force say so: STALE.

    Attributes:
        range_uN: beyond it a reading is SATURATED.
        resolution_uN: smallest difference that the reading can show.
        bandwidth_hz: of the sensor and its amplifier.
        stiffness_uN_per_um: of the sensor's own spring.
        axis: unit vector in the rig's frame along which a push on the tip reads positive.
        stream_rate_hz: the rate at which a tare is taken.
        tares: all zeros taken since the sensor was made, newest last.
    """

    sample_type = ForceSample

    range_uN: Range
    resolution_uN: float
    bandwidth_hz: float
    stiffness_uN_per_um: float
    axis: Vector
    stream_rate_hz: float

    def __init__(self, name: str, *, clock: Clock, bus: Bus) -> None:
        super().__init__(name, clock=clock, bus=bus)
        self.tares: tuple[Tare, ...] = ()
        self._tare: Tare | None = None
        self._shared = SharedStream(self._stream_at, lambda: self.streaming)

    # ------------------------------------------------------------------ public

    @property
    def tared(self) -> Tare | None:
        """The zero in use, if there is one."""
        return self._tare

    def tare(self, duration_s: float = 0.5) -> Tare:
        """Take the mean of the readings of `duration_s` as zero. Make sure that nothing touches the tip.

        Raises:
            SaturatedData: a reading was saturated or not valid. RefusedError: the reading drifts.
            LinkError: no or too few readings came. The old zero stays in use then.
        """
        what = "duration of the tare"
        check_range(duration_s, TARE_DURATIONS_S, what=what, unit="s", device=self.name, in_file="")
        with self._naming_errors():
            readings = self._collect(duration_s)
            tare = self._zero_from(readings)
        self._tare = tare
        self.tares = (*self.tares, tare)
        self._publish_event("tared", reason=f"{tare.offset_uN:.4g} µN")
        return tare

    def clear_tare(self) -> None:
        """Show the raw force again."""
        self._tare = None
        self._publish_event("tared", reason="cleared")

    @contextmanager
    def stream(self, rate_hz: float) -> Iterator[None]:
        """Publish samples on topic `<name>` while the context is open, at `rate_hz` or faster.

        All who want a stream share one, a force guard and a routine for instance; the highest rate holds.

        Raises:
            OutOfRange: the sensor or its line cannot. LinkError: it does not answer.
        """
        with self._shared.at(rate_hz):
            yield

    # ------------------------------------------------------------------ for drivers

    def _stream_at(self, rate_hz: float) -> AbstractContextManager[None]:
        """The sensor's one stream; by default it is polled."""
        return super().stream(rate_hz)

    def _adopt(self, settings: ForceSensorSettings) -> None:
        """Take over what the rig file says."""
        self.range_uN = settings.range_uN
        self.resolution_uN = settings.resolution_uN
        self.bandwidth_hz = settings.bandwidth_hz
        self.stiffness_uN_per_um = settings.stiffness_uN_per_um
        self.axis = settings.axis
        self.stream_rate_hz = settings.rate_hz

    def _sample(
        self, raw_uN: float, *, t_ns: int, dt_ns: int, t_source: TimeSource, flags: frozenset[str] = frozenset()
    ) -> ForceSample:
        """A sample from a raw reading: no force, and a flag, beyond the range; nothing is judged without a sensor."""
        if not flags & _NOT_OF_A_SENSOR and not self.range_uN.min <= raw_uN <= self.range_uN.max:
            flags |= {SATURATED}
        tare = self._tare
        if tare is None:
            flags |= {UNTARED}
        offset_uN = tare.offset_uN if tare is not None else 0.0
        return ForceSample(
            t_ns=t_ns,
            dt_ns=dt_ns,
            t_source=t_source,
            device=self.name,
            seq=self._next_seq(),
            flags=flags,
            force_uN=math.nan if flags & INVALID else raw_uN - offset_uN,
            raw_uN=raw_uN,
            tare_uN=offset_uN,
        )

    def _publish_stale(self) -> None:
        """Say that no reading has come in time."""
        sample = self._sample(
            math.nan, t_ns=self.clock.now_ns(), dt_ns=0, t_source="computed", flags=frozenset({STALE})
        )
        self.clock.deliver(lambda: self.topic.publish(sample))

    def _poll(self) -> None:
        super()._poll()
        if self.link == "lost":
            self._publish_stale()

    def _stop(self) -> None:
        """A sensor does not move."""

    # ------------------------------------------------------------------ taring

    def _collect(self, duration_s: float) -> list[ForceSample]:
        self._require_open()
        readings: list[ForceSample] = []
        subscription = self.topic.subscribe(readings.append)
        try:
            if self.streaming:
                self.clock.sleep(duration_s)
            else:
                with self.stream(self.stream_rate_hz):
                    self.clock.sleep(duration_s)
        finally:
            subscription.cancel()
        if len(readings) < _FEWEST_READINGS:
            raise LinkTimeout(
                f"only {len(readings)} readings came within {duration_s:g} s",
                remedy="take more time for the tare, or check the sensor's cable and rate",
                moved="no",
            )
        return readings

    def _zero_from(self, readings: Sequence[ForceSample]) -> Tare:
        unusable = frozenset().union(*(reading.flags & INVALID for reading in readings))
        if unusable:
            raise SaturatedData(
                f"no zero can be taken: readings were {', '.join(sorted(unusable))}",
                remedy="free the tip and check sensor and cable, then tare again",
                moved="no",
            )
        raw = np.array([reading.raw_uN for reading in readings])
        time_s = np.array([(reading.t_ns - readings[0].t_ns) / NS_PER_S for reading in readings])
        centred_s = time_s - time_s.mean()
        spread_s2 = float(centred_s @ centred_s)
        slope = float(centred_s @ raw) / spread_s2 if spread_s2 > 0 else 0.0
        scatter = float(np.sqrt(np.mean((raw - raw.mean() - slope * centred_s) ** 2)))
        change_uN = slope * float(time_s[-1])
        # Noise within the bandwidth is the same in neighbouring readings: they count as fewer.
        repeats = max(1.0, len(readings) / max(2.0 * self.bandwidth_hz * float(time_s[-1]), 1.0))
        deviation = math.sqrt(repeats) * max(scatter, 0.3 * self.resolution_uN)
        certain = abs(slope) * math.sqrt(spread_s2) > _DRIFT_T * deviation
        if certain and abs(change_uN) > self.resolution_uN:
            raise RefusedError(
                f"no zero can be taken while the reading drifts: {change_uN:+.3g} µN in {time_s[-1]:.2g} s",
                remedy="wait until the tip is free and at rest and the amplifier warm, then tare again",
            )
        return Tare(
            t_ns=readings[-1].t_ns, offset_uN=float(raw.mean()), sigma_uN=float(raw.std(ddof=1)), n=len(readings)
        )
