"""The force guard of one tool: stops what moves, and takes the tool away, when it presses too hard."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from microdrivers.core.clock import Clock
from microdrivers.core.errors import ErrorTree, MicrodriversError, UnsafeError
from microdrivers.core.samples import ForceSample
from microdrivers.core.units import NS_PER_MS, seconds_to_ns
from microdrivers.devices.base import Device
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.force_sensor import DISCONNECTED, SATURATED, STALE, ForceSensor
from microdrivers.devices.motion_plan import MotionPlan
from microdrivers.devices.stage import Stage
from microdrivers.rig.safety_aftermath import Aftermath
from microdrivers.rig.safety_force_flow import ForceFlow
from microdrivers.rig.safety_retraction import Retraction
from microdrivers.rig.safety_section import ForceGuardSettings

BY = "force guard"
"""Who has stopped a stage, in its events and errors."""

LIMIT_RULE, DATA_RULE, TARE_RULE, RETRACTION_RULE = "force limit", "force data", "tare", "retraction"

_ROUNDING = 1.001
"""Of a largest speed: what its axes' shares may add up to."""

_BELOW_SHARE = 0.95
"""Of the limit: a trip is over below it, so that noise at the limit is not a trip a reading."""

_WORSE_SHARE = 0.1
"""Of the limit: a retraction that adds as much leads the wrong way, or tears at something."""

_AGAIN_NS = 20 * NS_PER_MS
LIMIT_REMEDY = (
    "look at what the tool touches; only stop() and retract() pass until the force is back below the limit and the "
    "tool has been taken away. If it touches nothing, it is the sensor's zero: tare, and state zero_within_uN, how far "
    "the zero may be off, in the rig file's safety section"
)
_MAY_PRESS = "; the tool may still press: retract() it, or free it by hand"
_OR_ZERO = ". If it touches nothing, it is the sensor's zero: tare, and state zero_within_uN in the rig file"
_DATA_REMEDY = "check the force sensor, its cable and its amplifier; stop() and retract() work all the same"


class Tell(Protocol):
    """Where interventions go: to the bus and the log."""

    def __call__(
        self, rule: str, reason: str, *, stage: str, sensor: str = "", value: float = math.nan,
        limit: float = math.nan, failed: bool = False,
    ) -> None:  # fmt: skip
        """Publish and log one."""


class ForceGuard:
    """One entry of `force_guards`. `take` is called with each reading before anybody else sees it.

    What is judged is the raw force less the tare, but a tare counts only as far as a zero can be off: what goes beyond
    `zero_uN` is load, so that no tare under load defeats the limit. Where the tared force is larger than that, it is
    judged: a zero far below 0 leaves no more to press with. A saturated reading is over any limit.

    A trip stops the guarded stage, then every other stage that may be moving; the tool is then retracted, if a move of
    its stage has been allowed since the rig was opened: before that it may be in somebody's hands.

    Args:
        settings: of the guard.
        devices: of the rig, some may be missing.
        clock: of the rig.
        tell: told of each intervention, after it.

    Attributes:
        tripped: why, from a trip until the force is back below the limit and the retraction has ended; else empty.
    """

    def __init__(
        self, settings: ForceGuardSettings, devices: Mapping[str, Device[Any]], *, clock: Clock, tell: Tell
    ) -> None:
        self.settings = settings
        self.tripped = ""
        self._devices = devices
        self._clock = clock
        self._tell = tell
        self._lock = threading.Lock()
        self._stale_ns = round(settings.stale_after_ms * NS_PER_MS)
        self._flow = ForceFlow(settings.sensor, devices, clock=clock, stale_after_ns=self._stale_ns, on_beat=self._beat)
        self._retraction = Retraction(self._the_stage, clock=clock, ended=self._retraction_ended)
        self._armed = False
        self._allowed = False
        self._blind = False
        self._unstopped = False
        self._stopped_ns = -_AGAIN_NS
        self._braking_until_ns = -1
        self._least_uN = math.inf
        self._most_uN = 0.0
        self._doubted_tare_uN = 0.0
        self._aftermath = Aftermath(settings, clock=clock)

    # ------------------------------------------------------------------ what the rig asks

    @property
    def retraction(self) -> Retraction:
        """Of this guard's tool."""
        return self._retraction

    @property
    def _stage(self) -> FineStage | None:
        stage = self._devices.get(self.settings.stage)
        return stage if isinstance(stage, FineStage) else None

    def _the_stage(self) -> FineStage:
        stage = self._stage
        assert stage is not None, "nothing is retracted that is not in the rig"
        return stage

    def allow(self, plan: MotionPlan) -> None:
        """Let the guarded stage begin to move, or to search its references.

        Raises:
            UnsafeError: no valid, fresh force data come, or the move is faster than this guard allows.
        """
        if plan.kind == "retraction":
            self._braking_until_ns = self._clock.now_ns()
            if not plan.straight:
                self._braking_until_ns += seconds_to_ns(self._the_stage().braking_s)
            return
        fastest_um_s = self.settings.max_speed_um_s
        if fastest_um_s is not None and plan.speed_um_s > _ROUNDING * fastest_um_s:
            raise UnsafeError(
                f"refused by the {BY}: {plan.speed_um_s:g} µm/s are faster than its max_speed_um_s, {fastest_um_s:g}",
                remedy=f"give a speed of at most {fastest_um_s:g} µm/s, or change the rig file's safety section",
            )
        self._flow.require(self.settings.stage)
        self._armed = self._allowed = True
        self._blind = False
        if self._flow.complaint:  # since it was looked at
            self._allowed = False
            self._flow.require(self.settings.stage)
            self._allowed = True

    def begin(self) -> None:
        """Have force data come, without moving anything.

        Raises:
            UnsafeError: none come.
        """
        self._flow.require(self.settings.stage)

    def rehearse(self) -> int:
        """Be handed a force over the limit, as a rehearsal: ns until the stop command has been handed to the line.

        The stage must be at rest. It is told to stop and nothing else: this is no trip.

        Raises:
            LinkError: the stop could not be sent.
        """
        start_ns = self._clock.now_ns()
        excess_uN = 2.0 * self.settings.max_force_uN
        sample = ForceSample(t_ns=start_ns, device=self.settings.sensor, force_uN=excess_uN, raw_uN=excess_uN)
        if self._is_over(self._judged_uN(sample)):
            self._the_stage().stop(by=BY, reason="rehearsal")
        return self._clock.now_ns() - start_ns

    def finish(self, timeout_s: float) -> None:
        """Wait until a tool that is being taken away has got there, and it is known whether it still presses."""
        if self._retraction.finish(timeout_s):
            self._aftermath.wait()

    def disarm(self) -> None:
        """Nothing is retracted any more."""
        self._retraction.disarm()

    def close(self) -> None:
        """End stream and retraction."""
        self._retraction.close()
        self._flow.close()

    # ------------------------------------------------------------------ readings

    def take(self, sample: ForceSample) -> None:
        """Judge a reading, and stop at once if it demands that; in the publisher's thread."""
        if STALE in sample.flags:
            return  # it is no reading: the age of the last one decides
        force_uN = self._judged_uN(sample)
        if abs(sample.tare_uN) > self.settings.zero_uN and sample.tare_uN != self._doubted_tare_uN:
            self._doubt_tare(sample.tare_uN)
        self._flow.take(sample)
        if math.isnan(force_uN):
            self._hold_while_blind()
        elif self._is_over(force_uN):
            self._hold_over_limit(force_uN, sample)
        elif self.tripped and abs(force_uN) <= _BELOW_SHARE * self.settings.max_force_uN:
            self._end_trip()
        self._look_after(sample, force_uN)

    def _judged_uN(self, sample: ForceSample) -> float:
        """The force that counts; infinite if it is beyond the sensor's range, NaN if it is not known."""
        if DISCONNECTED in sample.flags:
            return math.nan
        if SATURATED in sample.flags:
            return math.inf
        return max(self._load_uN(sample), sample.raw_uN - sample.tare_uN, key=abs)

    def _load_uN(self, sample: ForceSample) -> float:
        """The raw force less as much of the tare as a zero can be off; of a saturated sensor, where it stands."""
        return sample.raw_uN - self.settings.zero_of_uN(sample.tare_uN)

    def _is_over(self, force_uN: float) -> bool:
        return abs(force_uN) > self.settings.max_force_uN

    # ------------------------------------------------------------------ too much force

    def _hold_over_limit(self, force_uN: float, sample: ForceSample) -> None:
        stage, reason = self._stage, self._excess(force_uN)
        with self._lock:
            is_new, self.tripped = not self.tripped, self.tripped or reason
        retracting = self._retraction.active or (stage is not None and stage.retracting)
        if is_new:
            self._least_uN, self._most_uN = math.inf, 0.0
        self._most_uN = max(self._most_uN, force_uN, key=abs)
        if retracting:
            self._watch_retraction(stage, force_uN, sample)
        elif is_new:
            self._trip(reason, force_uN, retract=self._armed and stage is not None)
        else:
            moving = [each for each in self._stages_to_stop() if each.may_be_moving or self._unstopped]
            self._stop_again(moving, reason, LIMIT_REMEDY)

    def _trip(self, reason: str, force_uN: float, *, retract: bool) -> None:
        failures = self._stop(self._stages_to_stop(), reason, LIMIT_REMEDY)
        if retract:
            self._retraction.begin()
        what = f"{reason}; {'stopped, and the tool is taken away' if retract else 'stopped'}"
        self._told(LIMIT_RULE, what, value=force_uN, failures=failures)

    def _stages_to_stop(self) -> list[Stage[Any]]:
        """The guarded stage first; whatever else moves may be what presses."""
        own = self._stage
        others = [
            device
            for device in self._devices.values()
            if isinstance(device, Stage) and device is not own and device.may_be_moving
        ]
        return [*([own] if own is not None else []), *others]

    def _watch_retraction(self, stage: FineStage | None, force_uN: float, sample: ForceSample) -> None:
        """Stop a retraction that makes it worse; from then on only a person knows what to do."""
        if stage is None or not stage.retracting or stage.being_commanded:
            return
        begun_ns = stage.commanded_ns
        if begun_ns <= self._stopped_ns or sample.t_ns < max(begun_ns, self._braking_until_ns):
            return  # it has not been commanded yet, or the reading is of what was still braking
        load_uN = abs(self._load_uN(sample))
        self._least_uN = min(self._least_uN, load_uN)
        if not load_uN > self._least_uN + _WORSE_SHARE * self.settings.max_force_uN:
            return
        self._least_uN = math.inf
        reason = f"retracting raises the force: {self._excess(force_uN)}"
        remedy = "free the tool by hand, and check retract_um of the stage in the rig file: it leads the wrong way"
        failures = self._stop([stage], reason, remedy)
        self._told(RETRACTION_RULE, f"{reason}; stopped", value=force_uN, failures=failures)

    def _end_trip(self) -> None:
        with self._lock:
            if not self._retraction.active:
                self.tripped = ""

    def _retraction_ended(self, what: str, succeeded: bool) -> None:
        sensor = self._devices.get(self.settings.sensor)
        if succeeded and isinstance(sensor, ForceSensor):
            self._aftermath.begin(self._the_stage(), sensor)
        most_uN = self._most_uN
        most = "beyond the sensor's range" if math.isinf(most_uN) else f"{most_uN:.5g} µN"
        told = f"{what} (the largest force was {most}){'' if succeeded else _MAY_PRESS}"
        self._told(RETRACTION_RULE, told, value=most_uN, failed=not succeeded)

    def _look_after(self, sample: ForceSample, force_uN: float) -> None:
        """What the tool was taken away from may come after it."""
        stage = self._stage
        left_uN = self._aftermath.take(stage, sample, force_uN) if stage is not None else None
        if left_uN is not None:
            name = self.settings.sensor
            feels = f"{name} is saturated" if math.isinf(left_uN) else f"{name} feels {left_uN:.4g} µN"
            if abs(sample.tare_uN) > self.settings.zero_uN:
                feels += f" (of its tare of {sample.tare_uN:.4g} µN only {self.settings.zero_uN:g} µN count)"
            what = f"the tool was taken away, and {feels} where it stands{_MAY_PRESS}{_OR_ZERO}"
            self._told(RETRACTION_RULE, what, value=left_uN, failed=True)

    def _excess(self, force_uN: float) -> str:
        name, limit_uN = self.settings.sensor, self.settings.max_force_uN
        if math.isinf(force_uN):
            return f"{name} is saturated, so the force is over the limit of {limit_uN:g} µN"
        return f"{name} feels {force_uN:.5g} µN, over the limit of {limit_uN:g} µN"

    def _doubt_tare(self, tare_uN: float) -> None:
        self._doubted_tare_uN = tare_uN
        what = (
            f"the tare of {self.settings.sensor}, {tare_uN:.5g} µN, is more than a zero may be off: all beyond "
            f"{self.settings.zero_uN:g} µN counts as load. Free the tip and tare again; if it was free, state "
            "zero_within_uN in the rig file"
        )
        self._told(TARE_RULE, what, value=tare_uN, limit=self.settings.zero_uN)

    # ------------------------------------------------------------------ too little data

    def _beat(self) -> None:
        """Look at the age of the data while the stage moves."""
        stage = self._stage
        if stage is None or not stage.may_be_moving:
            self._allowed = False
        elif self._flow.complaint:
            self._hold_while_blind()

    def _hold_while_blind(self) -> None:
        stage = self._stage
        if not self._allowed or stage is None or stage.retracting or self._retraction.active:
            return
        if not (stage.may_be_moving or self._unstopped):
            return
        reason = self._flow.complaint or "the force is not known"
        if self._blind:
            self._stop_again([stage], reason, _DATA_REMEDY)
            return
        self._blind = True
        failures = self._stop([stage], reason, _DATA_REMEDY)
        self._told(DATA_RULE, f"{reason}; stopped", limit=self.settings.stale_after_ms, failures=failures)

    # ------------------------------------------------------------------ stopping and telling

    def _stop(self, stages: Sequence[Stage[Any]], reason: str, remedy: str) -> list[MicrodriversError]:
        """Tell all to stop, whatever becomes of one of them."""
        self._stopped_ns = self._clock.now_ns()
        failures: list[MicrodriversError] = []
        for stage in stages:
            try:
                stage.stop(by=BY, reason=reason, remedy=remedy)
            except MicrodriversError as error:
                failures.append(error)
        self._unstopped = bool(failures)
        return failures

    def _stop_again(self, stages: Sequence[Stage[Any]], reason: str, remedy: str) -> None:
        """Tell those again that were being commanded, or could not be reached; this is one intervention."""
        if stages and self._clock.now_ns() - self._stopped_ns >= _AGAIN_NS:
            self._stop(stages, reason, remedy)

    def _told(
        self, rule: str, what: str, *, value: float = math.nan, limit: float | None = None, failed: bool = False,
        failures: Sequence[MicrodriversError] = (),
    ) -> None:  # fmt: skip
        own = self.settings
        if failures:
            what = f"{what}; NOT STOPPED: {'; '.join(str(error) for error in failures)}"
        self._tell(
            rule, what, stage=own.stage, sensor=own.sensor, value=value,
            limit=own.max_force_uN if limit is None else limit, failed=failed or bool(failures),
        )  # fmt: skip
        if failures:
            self._surface(ErrorTree(f"the {BY} could not stop every stage:", failures, remedy="use the emergency stop"))

    def _surface(self, error: MicrodriversError) -> None:
        """Have the main program see it in its next wait; the publisher goes on."""

        def raise_it() -> None:
            raise error

        self._clock.call_at(self._clock.now_ns(), raise_it, name=BY)
