"""A specimen identified while it is indented: eqs. (21)–(25) of Bilen et al. in recursive form."""

from __future__ import annotations

import math
from collections import deque
from typing import Literal, NamedTuple

from microdrivers.core.contact_samples import IndentationSample, SpecimenEstimate
from microdrivers.core.errors import OutOfRange
from microdrivers.core.samples import Sample
from microdrivers.estimators.force.four_samples import FourSampleRecursion, Scales
from microdrivers.estimators.force.local_motion import InstantMotion, LocalMotion, MotionSettings
from microdrivers.estimators.force.onset import ForceOnset, Onset

Branch = Literal["loading", "unloading"]

_FLAGS: dict[Branch | None, frozenset[str]] = {
    None: frozenset(),
    "loading": frozenset({"LOADING"}),
    "unloading": frozenset({"UNLOADING"}),
}
_MOVES_SIGMAS = 4.0
_FORCE_SIGMAS = 5.0
LEAST_CLEARANCE = 2


class RecursionSettings(NamedTuple):
    """How the recursion forgets, and what it leaves out.

    Attributes:
        forgetting: λ from sample to sample, in (0, 1].
        branch_forgetting: λ at the first sample after the motion has changed its sign, in [0, 1].
        separate_branches: keep one estimate for loading and one for unloading instead; each keeps its memory.
        with_mass: estimate m too, from fitted parabolas.
        ridge: δ of eq. (24), on columns divided by `scales`.
        scales: of compression, velocity and acceleration.
        clearance: samples next to a corner of the motion that are left out, on either side, for the fits of their
            velocities lean to the other and share its noise; ≥ 2, or reversals are smeared.
        lag, window: samples that must follow one, and those in the fit of its velocity; see `MotionSettings`.
        max_gap_s: samples further apart than this give no velocity across the gap.
        least_share: a force below this share of the largest, in [0, 1), is not used: the tool may have left the
            specimen.
        baseline_sigma_uN: the force before contact is taken to scatter by this at least, > 0; see `ForceOnset`.
    """

    forgetting: float = 0.999
    branch_forgetting: float = 0.0
    separate_branches: bool = False
    with_mass: bool = False
    ridge: float = 1e-11
    scales: Scales = Scales()
    clearance: int = 8
    lag: int = 13
    window: int = 25
    max_gap_s: float = 0.25
    least_share: float = 0.01
    baseline_sigma_uN: float = 0.01

    def check(self) -> None:
        """Refuse settings that forget everything at once, smear reversals or see no contact.

        Raises:
            OutOfRange: one is outside its range. What `FourSampleRecursion` and `LocalMotion` take is theirs to check.
        """
        for name, fine, expected in (
            ("forgetting", 0.0 < self.forgetting <= 1.0, "above 0 and at most 1; 1 forgets nothing"),
            ("branch_forgetting", 0.0 <= self.branch_forgetting <= 1.0, "from 0 to 1; 0 begins anew at a reversal"),
            ("clearance", self.clearance >= LEAST_CLEARANCE, f"of {LEAST_CLEARANCE} samples or more"),
            ("least_share", 0.0 <= self.least_share < 1.0, "from 0 to below 1"),
            ("baseline_sigma_uN", 0.0 < self.baseline_sigma_uN < math.inf, "above 0 µN"),
        ):
            if not fine:
                raise OutOfRange(f"{name} is {getattr(self, name)}", remedy=f"give a number {expected}")


class SpecimenRecursion:
    """Indentations in; out, `lag` samples later, the running estimate of (k1, k2, b), or with m.

    The last `lag` samples of a record are left out: where the motion has a corner there, none that follow show it.

    The velocity is the slope of a straight fit, centred on the sample, that never reaches across a reversal, a start
    or a stop; the samples next to one are left out. Before contact nothing is estimated. Loading and unloading may
    differ: the memory is cut where the motion changes its sign, or each branch has its own estimate.

    An estimate carries the flag LOADING or UNLOADING: the branch that its sample belongs to. The slip of eq. (26) and
    whatever else lies outside eq. (21) bias it: that shows in the prediction error, not in the covariance, which is
    that of white noise in the force. The noise of the fitted velocities is not in it, neither that it is alike in
    neighbouring samples nor that it pulls b towards 0, nor is that of the contact point: with a strong damper, ±1.96
    standard deviations hold the truth in 75 % to 90 % of indentations, without one in 92 % to 98 %
    (`scripts/bench_specimen_recursion.py`). `identify` gives intervals that hold.

    Args:
        settings: how it forgets, and what it leaves out.
        contact_um: deformation at which the tool touches; the force must then be tared. None detects it, together
            with the baseline of the force, from the force itself: the record must begin before the contact.
        device: name under which the estimates are published.

    Raises:
        OutOfRange: a setting or `contact_um` is not finite or out of its range.
    """

    def __init__(
        self,
        settings: RecursionSettings | None = None,
        *,
        contact_um: float | None = None,
        device: str = "specimen",
    ) -> None:
        self.settings = chosen = settings or RecursionSettings()
        chosen.check()
        if contact_um is not None and not math.isfinite(contact_um):
            raise OutOfRange(f"contact_um is {contact_um}", remedy="give the deformation in µm, or None to detect it")
        self.device = device
        self.late_samples = 0
        self.excluded_samples = 0
        self.contact: Onset | None = None
        self._onset = ForceOnset(least_sigma_uN=chosen.baseline_sigma_uN) if contact_um is None else None
        if contact_um is not None:
            self.contact = Onset(t_ns=-1, contact_um=contact_um, baseline_uN=0.0, sigma_uN=0.0)
        self._motion = LocalMotion(
            MotionSettings(
                lag=chosen.lag, window=chosen.window, with_acceleration=chosen.with_mass, max_gap_s=chosen.max_gap_s
            )
        )
        self._waiting: deque[IndentationSample] = deque()
        self._newest_ns: int | None = None
        self._branch: Branch | None = None
        self._largest_uN = 0.0
        loading = self._new_recursion()
        unloading = self._new_recursion() if chosen.separate_branches else loading
        self._recursions: dict[Branch, FourSampleRecursion] = {"loading": loading, "unloading": unloading}
        self._seq = 0

    def _new_recursion(self) -> FourSampleRecursion:
        return FourSampleRecursion(
            scales=self.settings.scales, ridge=self.settings.ridge, with_mass=self.settings.with_mass
        )

    def recursion(self, branch: Branch = "loading") -> FourSampleRecursion:
        """What has been summed up of a branch; the same for both unless they are separate."""
        return self._recursions[branch]

    def update(self, sample: Sample) -> list[SpecimenEstimate]:
        """Take one indentation; other samples are ignored, and so is one that is not newer than all before.

        Returns:
            The estimates that it gave rise to, oldest first: one for each sample that was used.
        """
        if not isinstance(sample, IndentationSample):
            return []
        if self._newest_ns is not None and sample.t_ns <= self._newest_ns:
            self.late_samples += 1
            return []
        if not math.isfinite(sample.force_uN + sample.deformation_um):
            self.excluded_samples += 1
            return []
        self._newest_ns = sample.t_ns
        if self.contact is None:
            assert self._onset is not None
            self.contact = self._onset.update(
                sample.t_ns, sample.deformation_um, sample.deformation_sigma_um, sample.force_uN
            )
        self._waiting.append(sample)
        estimates = []
        for motion in self._motion.update(sample.t_ns, sample.deformation_um, sample.deformation_sigma_um):
            estimate = self._take(self._waiting.popleft(), motion)
            if estimate is not None:
                estimates.append(estimate)
        return estimates

    # ------------------------------------------------------------------ one sample

    def _take(self, sample: IndentationSample, motion: InstantMotion) -> SpecimenEstimate | None:
        contact = self.contact
        if contact is None or motion.t_ns < contact.t_ns:
            return None
        x_um, force_uN = motion.position_um - contact.contact_um, sample.force_uN - contact.baseline_uN
        if not self._is_usable(motion, x_um, force_uN, contact.sigma_uN):
            self.excluded_samples += 1
            return None
        forgetting = self._follow(motion)
        recursion = self._recursions[self._branch or "loading"]
        known = recursion.spread().determined
        predicted_uN = recursion.predict_uN(x_um=x_um, v_um_s=motion.velocity_um_s, a_um_s2=motion.acceleration_um_s2)
        recursion.update(
            x_um=x_um,
            v_um_s=motion.velocity_um_s,
            a_um_s2=motion.acceleration_um_s2,
            force_uN=force_uN,
            forgetting=forgetting,
        )
        return self._report(sample, recursion, force_uN - predicted_uN if known else math.nan)

    def _is_usable(self, motion: InstantMotion, x_um: float, force_uN: float, sigma_uN: float) -> bool:
        """Whether the tool presses, and the velocity is known: neither next to a corner nor of a spike."""
        self._largest_uN = max(self._largest_uN, force_uN)
        least_uN = max(_FORCE_SIGMAS * sigma_uN, self.settings.least_share * self._largest_uN)
        clear = motion.clearance >= self.settings.clearance and math.isfinite(motion.velocity_sigma_um_s)
        return clear and not motion.spike and x_um > 0.0 and force_uN > least_uN

    def _follow(self, motion: InstantMotion) -> float:
        """λ for this sample; where the motion has changed its sign, the stack begins anew."""
        speed = motion.velocity_um_s
        if abs(speed) <= _MOVES_SIGMAS * motion.velocity_sigma_um_s:
            return self.settings.forgetting
        branch: Branch = "loading" if speed > 0.0 else "unloading"
        before, self._branch = self._branch, branch
        if before in (None, branch):
            return self.settings.forgetting
        self._recursions[branch].restart_stack()
        return self.settings.forgetting if self.settings.separate_branches else self.settings.branch_forgetting

    def _report(
        self, sample: IndentationSample, recursion: FourSampleRecursion, prediction_error_uN: float
    ) -> SpecimenEstimate:
        k1, k2, b, m = recursion.parameters
        spread = recursion.spread()
        seq, self._seq = self._seq, self._seq + 1
        return SpecimenEstimate(
            t_ns=sample.t_ns,
            dt_ns=sample.dt_ns,
            t_source="computed",
            device=self.device,
            seq=seq,
            flags=sample.flags | _FLAGS[self._branch],
            k1_uN_per_um=k1,
            k2_uN_per_um3=k2,
            b_uN_s_per_um=b,
            m_kg=m,
            covariance=spread.covariance,
            prediction_error_uN=prediction_error_uN,
            condition_number=spread.condition if spread.determined else math.inf,
            valid=spread.determined,
        )
