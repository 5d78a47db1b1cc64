"""Guarded motion: what the rig file's safety section demands of every move, whoever commands it."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from functools import partial
from typing import Any

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.contact_samples import Intervention
from microdrivers.core.errors import UnsafeError
from microdrivers.core.samples import ForceSample, Sample
from microdrivers.core.units import NS_PER_S, seconds_to_ns
from microdrivers.devices.base import Device
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.motion_plan import MotionPlan
from microdrivers.devices.stage import Stage
from microdrivers.rig.safety_force_guard import BY, LIMIT_REMEDY, ForceGuard
from microdrivers.rig.safety_keep_out import KeepOut
from microdrivers.rig.safety_section import SafetySection

TOPIC = "safety"
REFUSAL_RULE = "refusal"
KEEP_OUT_RULE = "keep-out"

_LONGEST_RETRACTION_S = 30.0

_log = logging.getLogger(__name__)


class Safety:
    """The force guards and keep-out boxes of a rig; a rule of all its stages. See docs/decisions/0016.

    What it does is told on topic `safety` and in the log.

    Args:
        section: of the rig file.
        devices: of the rig, as it will use them.
        clock, bus: of the rig.

    Attributes:
        guards: by the name of the sensor.
        keep_out: the boxes.
    """

    def __init__(self, section: SafetySection, devices: Mapping[str, Device[Any]], *, clock: Clock, bus: Bus) -> None:
        self.guards: Mapping[str, ForceGuard] = {
            each.sensor: ForceGuard(each, devices, clock=clock, tell=self._tell) for each in section.force_guards
        }
        self.keep_out = KeepOut(section.keep_out)
        self._clock = clock
        self._topic = bus.topic(TOPIC, Intervention)
        self._seq = 0
        if self.guards:
            bus.guard(self._take)
        if self.guards or section.keep_out:
            for device in devices.values():
                if isinstance(device, Stage):
                    device.rules = (*device.rules, self)

    # ------------------------------------------------------------------ for routines

    def limit_uN(self, sensor: str, *, tare_uN: float = 0.0) -> float | None:
        """The largest push, tared, that a sensor's guard allows; None if it has no guard."""
        guard = self.guards.get(sensor)
        if guard is None:
            return None
        return guard.settings.max_force_uN - max(tare_uN - guard.settings.zero_of_uN(tare_uN), 0.0)

    def max_speed_um_s(self, sensor: str) -> float:
        """The largest speed that a sensor's guard allows its stage; infinite if it states none."""
        guard = self.guards.get(sensor)
        return math.inf if guard is None else guard.settings.max_speed_um_s or math.inf

    @property
    def tripped(self) -> Mapping[str, str]:
        """By sensor, why its guard has tripped, of those that have and are not over it."""
        return {sensor: guard.tripped for sensor, guard in self.guards.items() if guard.tripped}

    def took_away(self, stage: str) -> bool:
        """Whether the last that moved a stage was a guard, which has taken its tool away."""
        return any(guard.retraction.took_away for guard in self._guards_of(stage))

    def begin(self, stage: str) -> None:
        """Have the forces come that guard a stage, as its first move does. Nothing moves.

        Raises:
            UnsafeError: none come.
        """
        for guard in self._guards_of(stage):
            guard.begin()

    # ------------------------------------------------------------------ rule of the stages

    def check(self, stage: Stage[Any], plan: MotionPlan) -> None:
        """Let a motion pass; see `MotionRule`.

        Raises:
            UnsafeError: a tool presses too hard, the way leads into a keep-out box, or no forces come.
        """
        try:
            self._refuse_while_tripped(plan)
            if isinstance(stage, FineStage):
                self.keep_out.check(stage, plan)
            for guard in self._guards_of(stage.name):
                guard.allow(plan)
        except UnsafeError as error:
            self._publish(REFUSAL_RULE, error.what, stage=stage.name)
            _log.info("%s: %s", stage.name, error.what)
            raise

    def free_share(self, stage: Stage[Any], plan: MotionPlan) -> float:
        """How much of a way no keep-out box blocks."""
        return self.keep_out.free_share(stage, plan) if isinstance(stage, FineStage) else 1.0

    def found_references(self, stage: Stage[Any]) -> None:
        """Say if a search for references, whose way is the drives' choice, has ended with the tip inside a box.

        Raises:
            LinkError: it could not be asked where the stage is.
        """
        trapped = self.trapped(stage)
        if trapped is not None:
            reason = f"the search for references has ended where no tool may be: {trapped.what}; {trapped.remedy}"
            self._tell(KEEP_OUT_RULE, reason, stage=stage.name, failed=True)

    def trapped(self, stage: Stage[Any]) -> UnsafeError | None:
        """What is to be said of a tip that is inside a keep-out box now; None if it is in none, or nobody knows.

        Raises:
            LinkError: it could not be asked where the stage is.
        """
        if not self.keep_out or not isinstance(stage, FineStage) or not all(stage.referenced.values()):
            return None
        return self.keep_out.trapped(stage, stage.read().position)

    # ------------------------------------------------------------------ the rig's end

    def finish(self) -> None:
        """Wait until tools that are being taken away have got there, and it is known whether they still press."""
        deadline_ns = self._clock.now_ns() + seconds_to_ns(_LONGEST_RETRACTION_S)
        for guard in self.guards.values():
            guard.finish(max(0.0, (deadline_ns - self._clock.now_ns()) / NS_PER_S))

    def disarm(self) -> None:
        """Nothing begins to move by itself from now on."""
        for guard in self.guards.values():
            guard.disarm()

    def close(self) -> None:
        """End what was started: streams, timers."""
        for guard in self.guards.values():
            guard.close()

    # ------------------------------------------------------------------ inside

    def _refuse_while_tripped(self, plan: MotionPlan) -> None:
        """Let only retractions pass while a tool presses too hard: any stage may be what presses."""
        for guard in self.guards.values():
            if guard.tripped and plan.kind != "retraction":
                raise UnsafeError(f"refused by the {BY}: {guard.tripped}", remedy=LIMIT_REMEDY)

    def _guards_of(self, stage: str) -> list[ForceGuard]:
        return [guard for guard in self.guards.values() if guard.settings.stage == stage]

    def _take(self, sample: Sample) -> None:
        if isinstance(sample, ForceSample):
            guard = self.guards.get(sample.device)
            if guard is not None:
                guard.take(sample)

    def _tell(
        self, rule: str, reason: str, *, stage: str, sensor: str = "", value: float = math.nan,
        limit: float = math.nan, failed: bool = False,
    ) -> None:  # fmt: skip
        self._publish(rule, reason, stage=stage, sensor=sensor, value=value, limit=limit)
        _log.log(logging.ERROR if failed else logging.WARNING, "%s: %s: %s", stage, rule, reason)

    def _publish(
        self, rule: str, reason: str, *, stage: str, sensor: str = "", value: float = math.nan, limit: float = math.nan
    ) -> None:
        seq, self._seq = self._seq, self._seq + 1
        sample = Intervention(
            t_ns=self._clock.now_ns(), device=TOPIC, seq=seq, t_source="computed", rule=rule, stage=stage,
            sensor=sensor, value=value, limit=limit, reason=reason,
        )  # fmt: skip
        self._clock.deliver(partial(self._topic.publish, sample))
