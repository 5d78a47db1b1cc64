"""Force from the camera alone: the deformation of a specimen that has been identified before (Bilen et al., II.B)."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from microdrivers.core.contact_samples import DeformationSample, VisionForceSample
from microdrivers.core.errors import DataError
from microdrivers.core.samples import Sample
from microdrivers.core.units import NS_PER_S
from microdrivers.estimators.force.local_motion import InstantMotion, LocalMotion, MotionSettings
from microdrivers.estimators.force.model import (
    SpecimenModel,
    check_model,
    force_uN,
    slip_speed_um_s,
    slipped_um,
    stiffness_uN_per_um,
)

OUTSIDE_RANGE, LOST, NO_VELOCITY = "OUTSIDE_RANGE", "LOST", "NO_VELOCITY"
MAY_BE_RELEASED = "MAY_BE_RELEASED"

_TOUCH_SIGMAS = 5.0
_RANGE_SIGMAS = 5.0
_AT_REST_UM = 1.0
_MOVES_SIGMAS, _MOVES_SHARE = 5.0, 0.1
"""What is no rest: a speed beyond its noise, and beyond this share of the fastest since the contact."""


class VisionForceSettings(NamedTuple):
    """How the velocity is told.

    Attributes:
        lag: frames that must follow one before its force is published, ≥ 4: what it takes to see on which side of a
            reversal a frame lies. At 30 Hz, 5 frames are 167 ms.
        window: frames in the straight fit that gives the velocity, fewer after a corner of the motion. Where the speed
            changes smoothly, the velocity is that of `(window + 1)/2 − lag` frames before, and `sigma_uN` contains what
            that hides.
        max_gap_s: > 0; frames further apart than this give no velocity across the gap, and no force if the model has
            a damper, be it on one way only: a camera at fewer than `1/max_gap_s` frames a second tells none, only
            `NO_VELOCITY`.
    """

    lag: int = 5
    window: int = 20
    max_gap_s: float = 0.25


class VisionForce:
    """Deformations in; out, `lag` frames later and stamped with the frame's own time, the force that the model tells.

    There is no force until the camera shows contact: until the deformation begins to grow so that the model's force
    exceeds what noise explains. It ends when the model's force is used up; it is never negative. The slip of eq. (26)
    runs from the instant at which the deformation began. The mass is left out: a camera tells no acceleration.

    `sigma_uN` adds up the model's covariance and residual, the noise of the deformation and that of the velocity, and
    the damper's force of such changes of speed as the velocity lags behind: as large as any of the last two windows.
    A change of speed shows after some frames; those told until then state it only if there was one like it before.
    A frame that is lost is published at once, and before it all that wait, by what was known until then.

    Flags: `LOST`, no deformation was seen; `NO_VELOCITY`, there is no velocity and so no force, both NaN
    (without any damper, the springs' force is told all the same, and only the velocity is NaN);
    `OUTSIDE_RANGE`, deeper or faster than the model was characterised, or on a way back of which it knows nothing;
    `MAY_BE_RELEASED`, the specimen rests on its way back with a force left by the model, beyond noise: the tool holds
    it there, or has left a specimen that lies farther in than the model has it, which a camera cannot tell apart.

    Args:
        model: the identified specimen.
        settings: how the velocity is told.
        device: name under which the samples are published.

    Raises:
        OutOfRange: a number of the model or a setting is not finite or out of its range.
    """

    def __init__(
        self, model: SpecimenModel, settings: VisionForceSettings | None = None, *, device: str = "vision_force"
    ) -> None:
        check_model(model)
        self.model = model
        self.settings = settings or VisionForceSettings()
        self.device = device
        self.late_frames = 0
        self._motion = LocalMotion(
            MotionSettings(
                lag=self.settings.lag,
                window=self.settings.window,
                with_lateness=True,
                max_gap_s=self.settings.max_gap_s,
            )
        )
        self._lag = _Lag(self.settings.window)
        self._waiting: deque[DeformationSample] = deque()
        self._newest_ns: int | None = None
        self._touches = False
        self._touched_ns: int | None = None
        self._fastest_um_s = 0.0
        self._came_back = False
        self._seq = 0

    @property
    def touches(self) -> bool:
        """Whether the tool was in contact at the newest force published."""
        return self._touches

    @property
    def touched_ns(self) -> int | None:
        """When the contact began, as the camera shows it; None before it, and after the specimen has come back."""
        return self._touched_ns

    def update(self, sample: Sample) -> list[VisionForceSample]:
        """Take one deformation; other samples are ignored, and so is one that is not newer than all before.

        Returns:
            The forces that are now certain, oldest first.

        Raises:
            DataError: a standard deviation is negative.
        """
        if not isinstance(sample, DeformationSample):
            return []
        if sample.sigma_um < 0.0:
            raise DataError(
                f"a deformation has the standard deviation {sample.sigma_um:g} µm",
                remedy="state one that is not negative, or NaN where it is not known",
            )
        if self._newest_ns is not None and sample.t_ns <= self._newest_ns:
            self.late_frames += 1
            return []
        self._newest_ns = sample.t_ns
        if not sample.found or not math.isfinite(sample.deformation_um):
            return [*self.finish(), self._publish(sample, math.nan, math.nan, math.nan, {LOST})]
        self._waiting.append(sample)
        return [
            self._force(motion) for motion in self._motion.update(sample.t_ns, sample.deformation_um, sample.sigma_um)
        ]

    def finish(self) -> list[VisionForceSample]:
        """No more deformations come: the forces of the frames that wait, by what is known now, oldest first."""
        return [self._force(motion) for motion in self._motion.tell_now()]

    # ------------------------------------------------------------------ one frame

    def _force(self, motion: InstantMotion) -> VisionForceSample:
        frame = self._waiting.popleft()
        x_um, v_um_s = self._compression(motion)
        seen_uN = self._seen_sigma_uN(motion, x_um, v_um_s)
        velocity_um_s = motion.velocity_um_s if math.isfinite(motion.velocity_sigma_um_s) else math.nan
        damper = self._damper(v_um_s) if motion.corner_um_s == 0.0 else self._stronger_damper
        hidden_uN = damper * self._lag.hidden_um_s(motion)
        if not math.isfinite(seen_uN):
            return self._publish(frame, math.nan, math.nan, math.nan, {NO_VELOCITY})
        noise_uN = math.hypot(seen_uN, hidden_uN, self.model.residual_uN)
        raw_uN = float(force_uN(self.model, x_um, v_um_s, adhesion=True))
        if not self._touches and raw_uN > _TOUCH_SIGMAS * seen_uN:
            self._touches = True
            self._fastest_um_s = 0.0
            if self._touched_ns is None:
                self._touched_ns = motion.begin_ns if motion.after_corner else motion.t_ns
                x_um, v_um_s = self._compression(motion)
                raw_uN = float(force_uN(self.model, x_um, v_um_s, adhesion=True))
        elif raw_uN <= 0.0:
            self._touches = False
        if not self._touches and motion.position_um - self.model.contact_um < _AT_REST_UM:
            self._touched_ns = None
        # That no force is left is the model's word, too, until the specimen has come back.
        outside = self._touched_ns is not None and self._is_outside(motion, x_um, v_um_s)
        flags = {OUTSIDE_RANGE} if outside else set()
        if not self._touches:
            return self._publish(frame, 0.0, noise_uN, velocity_um_s, flags)
        if self._rests_on_its_way_back(motion) and raw_uN > _TOUCH_SIGMAS * seen_uN:
            flags.add(MAY_BE_RELEASED)
        sigma_uN = math.hypot(noise_uN, self._model_sigma_uN(x_um, v_um_s))
        return self._publish(frame, max(raw_uN, 0.0), sigma_uN, velocity_um_s, flags)

    def _rests_on_its_way_back(self, motion: InstantMotion) -> bool:
        v_um_s = motion.velocity_um_s
        self._fastest_um_s = max(self._fastest_um_s, abs(v_um_s))
        if abs(v_um_s) > max(_MOVES_SIGMAS * motion.velocity_sigma_um_s, _MOVES_SHARE * self._fastest_um_s):
            self._came_back = v_um_s < 0.0
            return False
        return self._came_back

    def _compression(self, motion: InstantMotion) -> tuple[float, float]:
        """Compression x of eq. (21), µm, and its rate, µm/s, by eq. (26)."""
        x_um, v_um_s = motion.position_um - self.model.contact_um, motion.velocity_um_s
        if self._touched_ns is None or self.model.slip_um == 0.0:
            return x_um, v_um_s
        since_s = (motion.t_ns - self._touched_ns) / NS_PER_S
        return x_um - float(slipped_um(self.model, since_s)), v_um_s - float(slip_speed_um_s(self.model, since_s))

    # ------------------------------------------------------------------ uncertainty

    def _seen_sigma_uN(self, motion: InstantMotion, x_um: float, v_um_s: float) -> float:
        """Standard deviation from the noise of the deformation and of the velocity."""
        # Without a velocity neither is its sign known: any damper may be the one that acts.
        known = math.isfinite(motion.velocity_sigma_um_s)
        damper = self._damper(v_um_s) if known else self._either_damper
        from_velocity = damper * motion.velocity_sigma_um_s if damper else 0.0
        from_position = float(stiffness_uN_per_um(self.model, x_um)) * motion.sigma_um
        return math.hypot(from_position, from_velocity)

    def _damper(self, v_um_s: float) -> float:
        return self.model.b_loading_uN_s_per_um if v_um_s > 0.0 else self.model.b_unloading_uN_s_per_um

    @property
    def _either_damper(self) -> float:
        return self.model.b_loading_uN_s_per_um or self.model.b_unloading_uN_s_per_um

    @property
    def _stronger_damper(self) -> float:
        return max(self.model.b_loading_uN_s_per_um, self.model.b_unloading_uN_s_per_um)

    def _model_sigma_uN(self, x_um: float, v_um_s: float) -> float:
        """Standard deviation from the parameters' covariance; that of the damper while it damps like in loading."""
        if not self.model.covariance:
            return 0.0
        damped = v_um_s > 0.0 or self.model.b_unloading_uN_s_per_um == self.model.b_loading_uN_s_per_um
        slope = (x_um, x_um**3, v_um_s if damped else 0.0)
        terms = zip((p * q for p in slope for q in slope), self.model.covariance, strict=True)
        return math.sqrt(max(sum(weight * value for weight, value in terms), 0.0))

    def _is_outside(self, motion: InstantMotion, x_um: float, v_um_s: float) -> bool:
        deeper = x_um - _RANGE_SIGMAS * motion.sigma_um > self.model.deepest_um
        fastest_um_s = self.model.fastest_um_s if v_um_s > 0.0 else self.model.fastest_unloading_um_s
        return deeper or abs(v_um_s) - _RANGE_SIGMAS * motion.velocity_sigma_um_s > fastest_um_s

    def _publish(
        self, frame: DeformationSample, force_uN: float, sigma_uN: float, velocity_um_s: float, flags: set[str]
    ) -> VisionForceSample:
        seq, self._seq = self._seq, self._seq + 1
        return VisionForceSample(
            t_ns=frame.t_ns,
            dt_ns=frame.dt_ns,
            t_source="computed",
            device=self.device,
            seq=seq,
            flags=frame.flags | flags,
            force_uN=force_uN,
            sigma_uN=sigma_uN,
            deformation_um=frame.deformation_um,
            velocity_um_s=velocity_um_s,
        )


class _Lag:
    """By how much a velocity may be off because it is that of an earlier instant: as the speed has changed lately.

    Told by velocities that have no position in common, and no corner between, for slow changes; for quick ones by what
    the newest positions of each say otherwise than all of them. What their noise explains is taken off. The largest of
    the last two windows counts, also of before a corner; at a corner, half of its step.
    """

    def __init__(self, window: int) -> None:
        self._told: deque[InstantMotion] = deque(maxlen=window)
        self._change_um_s2: deque[float] = deque(maxlen=2 * window)
        self._late_um_s: deque[float] = deque(maxlen=2 * window)

    def hidden_um_s(self, motion: InstantMotion) -> float:
        """Standard deviation of that, for the next motion told."""
        if math.isnan(motion.velocity_sigma_um_s):
            return 0.0
        if self._told and self._told[-1].begin_ns != motion.begin_ns:
            self._told.clear()
        if len(self._told) == self._told.maxlen:
            before = self._told[0]
            noise = motion.velocity_sigma_um_s**2 + before.velocity_sigma_um_s**2
            change_um_s = math.sqrt(max((motion.velocity_um_s - before.velocity_um_s) ** 2 - noise, 0.0))
            self._change_um_s2.append(change_um_s * NS_PER_S / (motion.t_ns - before.t_ns))
        self._told.append(motion)
        self._late_um_s.append(motion.late_um_s)
        slow_um_s = abs(motion.velocity_age_s) * max(self._change_um_s2, default=0.0)
        return math.hypot(max(slow_um_s, *self._late_um_s), 0.5 * motion.corner_um_s)
