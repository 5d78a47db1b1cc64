"""The force data without which a guarded stage does not move."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any

from microdrivers.core.clock import Clock
from microdrivers.core.errors import MicrodriversError, UnsafeError
from microdrivers.core.samples import ForceSample
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.devices.base import Device
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.rig.safety_force_data import ForceData

_FIRST_READING_S = 0.5
_REMEMBERED_NS = 2 * NS_PER_S
_WITHOUT_FORCE = "stop() and retract() work all the same"


class ForceFlow:
    """Opens a sensor and its stream when a guarded stage is first to move, keeps it, and knows how old its data are.

    Args:
        sensor: its name.
        devices: of the rig; the sensor may be missing among them.
        clock: of the rig.
        stale_after_ns: readings that are older are no use.
        on_beat: called several times in that time while the stream is kept.
    """

    def __init__(
        self, sensor: str, devices: Mapping[str, Device[Any]], *, clock: Clock, stale_after_ns: int,
        on_beat: Callable[[], object],
    ) -> None:  # fmt: skip
        self._name = sensor
        self._devices = devices
        self._clock = clock
        self._stale_after_ns = stale_after_ns
        self._on_beat = on_beat
        self._kept: ExitStack | None = None
        self._beginning = threading.RLock()
        self._data = ForceData(sensor, clock=clock, stale_after_ns=stale_after_ns)
        self._looked_ns = -1
        self._late_ns = 0
        self._late_until_ns = -1

    # ------------------------------------------------------------------ what comes

    def take(self, sample: ForceSample) -> None:
        """A reading has come."""
        self._data.take(sample)

    @property
    def complaint(self) -> str:
        """What is wrong with the data now; empty if they are valid and fresh."""
        why = self._data.complaint
        return f"{why}{self._busy}" if why and not self._data.invalid else why

    @property
    def _busy(self) -> str:
        """What is added if this computer may be to blame."""
        if self._clock.now_ns() >= self._late_until_ns:
            return ""
        late_ms = self._late_ns / NS_PER_MS
        return f" (this computer is too busy: it looked {late_ms:.0f} ms late; have it do less at once)"

    # ------------------------------------------------------------------ seeing to it that it comes

    def require(self, stage: str) -> None:
        """Let a stage move only if valid, fresh readings come; starts the sensor's stream if need be.

        Raises:
            UnsafeError: none come.
        """
        sensor = self._devices.get(self._name)
        if not isinstance(sensor, ForceSensor):
            raise UnsafeError(
                f"{stage} moves only while {self._name} is read, which is not among the devices that this rig was "
                "built with",
                device=stage,
                remedy=f"open the rig with {self._name} as well; {_WITHOUT_FORCE}",
            )
        with self._beginning:
            self._keep_streaming(sensor, stage)
            if self.complaint:
                self._data.wait(_FIRST_READING_S)
        if self.complaint:
            raise UnsafeError(
                f"{stage} moves only while valid forces come: {self.complaint}",
                device=stage,
                remedy=f"check {self._name}, its cable and its amplifier; {_WITHOUT_FORCE}. To move without, take "
                "the guard out of the rig file's safety section",
            )

    def close(self) -> None:
        """Keep the stream no longer; idempotent."""
        kept, self._kept = self._kept, None
        if kept is not None:
            kept.close()

    def _keep_streaming(self, sensor: ForceSensor, stage: str) -> None:
        if self._kept is not None and sensor.streaming and sensor.link != "closed":
            return
        self.close()
        try:
            if sensor.link != "lost":
                sensor.open()
            with ExitStack() as begun:
                begun.enter_context(sensor.stream(sensor.stream_rate_hz))
                period_s = self._stale_after_ns / 5 / NS_PER_S
                self._looked_ns = -1
                begun.callback(self._clock.every(period_s, self._beat, name=f"{self._name} guard").cancel)
                self._kept = begun.pop_all()
        except MicrodriversError as error:
            raise UnsafeError(
                f"{stage} moves only while {self._name} is read, which does not work: {error.what}",
                device=stage,
                remedy=f"{error.remedy or f'check {self._name}'}; {_WITHOUT_FORCE}",
            ) from error

    def _beat(self) -> None:
        now_ns, period_ns = self._clock.now_ns(), self._stale_after_ns // 5
        late_ns = now_ns - self._looked_ns - period_ns
        if self._looked_ns >= 0 and late_ns > period_ns:
            self._late_ns, self._late_until_ns = late_ns, now_ns + _REMEMBERED_NS
        self._looked_ns = now_ns
        self._on_beat()
