"""The probe on its way: it presses on only while valid forces come and nothing else speaks against it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from microdrivers.core.errors import DataError, MoveCancelled
from microdrivers.core.samples import ForceSample, Sample
from microdrivers.core.units import NS_PER_MS, NS_PER_S, seconds_to_ns
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.rig import Rig
from microdrivers.rig.safety_force_data import ForceData
from microdrivers.routines.force.watches import Felt
from microdrivers.routines.force.way import ProbingWay

_LOOK_S = 0.05
"""How often a stage at rest, or on its way to rest, is looked at."""

_PATIENCE = 10
"""Looks after which a stage that still moves is told to stop again."""

_PRESS_LESS = "press more slowly, or turn back farther below the limit: --max-force-uN"

_FIRST_READING_S = 0.5
"""How long a sensor's stream may take to begin."""

_STALE_S, _STALE_PERIODS = 0.1, 3
"""A reading that is older than either, or than a guard allows, is no use."""


class ProbeDrive:
    """Moves a probe along its way, and stops it when there is reason to, whether or not a guard watches.

    Args:
        rig: with the guards.
        stage: carries the sensor.
        sensor: presses.
        way: of the tip.
        speed_um_s: of the tip while it presses. free_um_s: of the stage where nothing is in the way.
    """

    def __init__(
        self, rig: Rig, stage: FineStage, sensor: ForceSensor, way: ProbingWay, *, speed_um_s: float, free_um_s: float
    ) -> None:
        self.way = way
        self._rig = rig
        self._stage = stage
        self._sensor = sensor
        self._clock = rig.clock
        self._speed_um_s = way.path_speed_um_s(speed_um_s)
        self._free_um_s = free_um_s
        guard = rig.safety.guards.get(sensor.name)
        own_ns = seconds_to_ns(max(_STALE_S, _STALE_PERIODS / sensor.stream_rate_hz))
        self._stale_ns = own_ns if guard is None else max(own_ns, round(guard.settings.stale_after_ms * NS_PER_MS))
        self._data = ForceData(sensor.name, clock=rig.clock, stale_after_ns=self._stale_ns)

    @property
    def place_um(self) -> float:
        """Where the tip is on its way now."""
        return self.way.place_um(self._stage.read().position)

    def go(self, place_um: float) -> None:
        """Move through free space."""
        self._stage.move_to(**self.way.targets(place_um), speed_um_s=self._free_um_s)

    @contextmanager
    def readings(self, felt: Felt) -> Iterator[None]:
        """Have forces come while the context is open, as `run` and `hold` need them."""
        self._data = data = ForceData(self._sensor.name, clock=self._clock, stale_after_ns=self._stale_ns)
        topic = self._rig.bus.topic(self._sensor.name, ForceSample)
        if topic.latest is not None:
            data.take(topic.latest)
        with ExitStack() as opened:
            for take in (data.take, felt.take):
                opened.callback(topic.subscribe(take).cancel)
            opened.enter_context(self._sensor.stream(self._sensor.stream_rate_hz))
            data.wait(_FIRST_READING_S)
            yield

    def run(
        self,
        place_um: float,
        enough: Callable[[], bool],
        show: Callable[[float], None] = lambda _um: None,
        *,
        below_limit: str = _PRESS_LESS,
    ) -> float:
        """Move at the experiment's speed until the place, or until enough; returns where the tip then is.

        Args:
            place_um: on the way.
            enough: asked with each reading and pose.
            show: told where the tip is.
            below_limit: what to do if the force guard intervenes.

        Raises:
            DataError: no valid force comes; the stage was stopped, or has not moved.
            MoveCancelled: the force guard, or somebody else, stopped the stage.
        """
        self._require_calm(below_limit)
        self._require_forces(self._data.complaint)
        if enough():
            return self.place_um
        move = self._stage.start_move_to(**self.way.targets(place_um), speed_um_s=self._speed_um_s)
        stopped_for: list[str] = []

        def look(_sample: Sample) -> None:
            why = self._data.complaint
            if (why or enough()) and not stopped_for and move.state == "running":
                stopped_for.append(why)
                self._stage.stop(by="experiment", reason=why or "far enough")

        with ExitStack() as watches:
            # Poses, too: they come also while no force does.
            watches.callback(self._rig.bus.topic(self._sensor.name, ForceSample).subscribe(look).cancel)
            watches.callback(self._stage.topic.subscribe(look).cancel)
            watches.callback(self._stage.topic.subscribe(lambda at: show(self.way.place_um(at.position))).cancel)
            try:
                move.wait()
            except MoveCancelled as cancelled:
                if not stopped_for:
                    raise
                self._require_calm(below_limit, cancelled)
                self.rest()
        self._require_forces("".join(stopped_for[:1]))
        return self.place_um

    def hold(self, duration_s: float, enough: Callable[[], bool]) -> None:
        """Stay where the tip is, less long if enough, if no valid force comes or if a guard intervenes."""
        until_ns = self._clock.now_ns() + seconds_to_ns(duration_s)
        while (left_ns := until_ns - self._clock.now_ns()) > 0:
            if enough() or self._data.complaint or self._intervened:
                return
            self._clock.sleep(min(_LOOK_S, left_ns / NS_PER_S))

    def rest(self) -> None:
        """Wait until a stopped stage stands; it is told again if it does not, for a stop may have been lost."""
        looks = 0
        while self._stage.read().moving:
            self._clock.sleep(_LOOK_S)
            looks += 1
            if looks % _PATIENCE == 0 and not self._intervened:
                self._stage.stop(by="experiment", reason="it still moves")

    def take_away(self) -> None:
        """Take the tool away from what it presses on, by the rig file's way out or the way on which it came."""
        if self._stage.retract_um is not None:
            self._stage.retract().wait()
        else:
            self.go(0.0)

    # ------------------------------------------------------------------ what ends it

    @property
    def _intervened(self) -> str:
        """What a force guard has done, if one has; empty otherwise."""
        safety = self._rig.safety
        taken = "the tool was taken away" if safety.took_away(self._stage.name) else ""
        return "; ".join(safety.tripped.values()) or taken

    def _require_calm(self, remedy: str, cancelled: MoveCancelled | None = None) -> None:
        """Raise if a guard has intervened, possibly while the stage still braked."""
        if intervened := self._intervened:
            raise MoveCancelled(
                f"the force guard intervened: {intervened}",
                device=self._stage.name,
                remedy=remedy,
            ) from cancelled

    def _require_forces(self, complaint: str) -> None:
        if complaint:
            raise DataError(
                f"the probe does not go on without valid forces: {complaint}",
                device=self._sensor.name,
                remedy="check the force sensor, its cable and its amplifier, then start again",
                moved="yes",
            )
