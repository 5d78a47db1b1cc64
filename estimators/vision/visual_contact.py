"""When and where a tool touched a specimen, by the camera alone."""

from __future__ import annotations

import math
from collections import deque
from itertools import takewhile
from typing import Literal, NamedTuple

import numpy as np

from microdrivers.core.contact_samples import DeformationSample
from microdrivers.core.units import NS_PER_S
from microdrivers.estimators.vision.template import FloatArray

_HISTORY = 120
"""Frames that are remembered: 4 s at 30 Hz."""

_REST_FRAMES = 5
"""Frames that show what rest is, at least."""

_REST_GAP = 5
"""Frames before a rise that may belong to it already, and do not count as rest."""

_THRESHOLD, _SLACK = 12.0, 1.0
"""Alarm of the sum, and deformation a frame that counts as none, in standard deviations; white noise exceeds them once
in 1e9 frames."""

_RISEN_SIGMAS, _CONFIRM_FRAMES = 5.0, 6
"""So many frames in a row must show a deformation beyond so many standard deviations, for the place to be found."""

_CONFIRM_SIGMAS = 15.0
"""Deformation, in standard deviations, at least, at which the event comes."""

_BEGUN = 0.3
"""Share of the newest deformation above which a frame belongs to the rise for sure."""

_TOGETHER, _TOGETHER_SIGMAS = 0.4, 3.0
"""Share of the way, and standard deviations besides, by which specimen and tip may differ and still go together."""

_LONGEST = 60
"""Frames after which a rise must have proved to be the tip's."""

_KEPT = 30
"""Frames of a rise that was not the tip's which show the new rest."""

_MOVING_SIGMAS = 3.0
"""Of a speed that is none of noise."""

_ROUNDS = 20
"""Most repetitions of the fit of the place; each changes which frames lie after the touch."""


class ContactEvent(NamedTuple):
    """The first touch.

    Attributes:
        t_ns: when; sigma_s: standard deviation of it, the frames' own times not included. NaN if the tip stood still.
        tip_um: where the tip was, in the samples' own coordinate; tip_sigma_um: standard deviation of it.
        deformation_um: what the samples called the deformation before the touch; deformation_sigma_um: of it.
        frame_seq: the first frame after the touch. frames: how many of them told the place.
    """

    t_ns: int
    sigma_s: float
    tip_um: float
    tip_sigma_um: float
    deformation_um: float
    deformation_sigma_um: float
    frame_seq: int
    frames: int


class VisualContact:
    """Detects the touch while the tip comes nearer: the contact point, at rest until then, moves along with it.

    A cumulative sum of the deformation against its mean at rest, in units of its own standard deviation, raises the
    alarm (Page's test). The place follows from the frames since the sum left zero: deformation = max(0, tip − place).
    A specimen that moves without the tip, or otherwise than it, is no contact; where it then lies is its new rest. A
    touch shows from about 0.14 standard deviations of deformation a frame on.

    Attributes:
        event: the touch; None before.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything; the specimen rests undeformed again."""
        self.event: ContactEvent | None = None
        self._samples: deque[DeformationSample] = deque(maxlen=_HISTORY)
        self._sum = 0.0
        self._moving = 0
        self._risen = 0

    def update(self, sample: DeformationSample) -> ContactEvent | None:
        """Take the next sample; returns the touch once, with the sample that confirms it."""
        if self.event is not None or not sample.found or not math.isfinite(sample.tip_um):
            return None
        self._samples.append(sample)
        resting = len(self._samples) - 1 - self._moving
        if resting < _REST_FRAMES:
            return None
        rest, rest_sigma = self._rest(resting)
        sigma = math.hypot(sample.sigma_um, rest_sigma)
        self._sum = max(0.0, self._sum + (sample.deformation_um - rest) / sigma - _SLACK)
        self._moving = self._moving + 1 if self._sum > 0.0 else 0
        risen = (sample.deformation_um - rest) / sigma
        self._risen = self._risen + 1 if risen > _RISEN_SIGMAS else 0
        if self._sum >= _THRESHOLD and self._risen >= _CONFIRM_FRAMES and risen >= _CONFIRM_SIGMAS:
            verdict = self._moves_along(rest)
            if verdict == "along":
                self.event = self._place(rest, rest_sigma)
            elif verdict == "otherwise":
                self._rest_anew(kept=0)
        elif self._moving >= _HISTORY - _REST_FRAMES or (self._moving > _LONGEST and not self._keeps_up(rest)):
            self._rest_anew(kept=_KEPT)
        return self.event

    def _rest_anew(self, *, kept: int) -> None:
        """Take the newest frames for rest."""
        self._samples = deque([*self._samples][len(self._samples) - kept :], maxlen=_HISTORY)
        self._sum, self._moving, self._risen = 0.0, 0, 0

    def _keeps_up(self, rest: float) -> bool:
        """Whether the specimen has come about as far as the tip has since the sum left zero."""
        newest = self._recent()[-_REST_FRAMES:]
        risen = float(np.mean([sample.deformation_um for sample in newest])) - rest
        came = float(np.mean([sample.tip_um for sample in newest])) - self._samples[-1 - self._moving].tip_um
        allowance = _TOGETHER_SIGMAS * math.hypot(newest[-1].sigma_um, newest[-1].tip_sigma_um)
        return abs(came - risen) < _TOGETHER * abs(risen) + allowance

    def _moves_along(self, rest: float) -> Literal["along", "otherwise", "undecided"]:
        """Whether the specimen has moved as the tip has since the sum left zero."""
        recent = self._recent()
        first, last = self._samples[-1 - self._moving], recent[-1]
        risen = last.deformation_um - rest
        # Not the first such frame: an earlier push may have come near it.
        rise = takewhile(lambda sample: sample.deformation_um - rest > _BEGUN * risen, reversed(recent))
        begun = [*rise][-1]
        further = last.deformation_um - begun.deformation_um
        allowance = _TOGETHER_SIGMAS * math.sqrt(2.0) * math.hypot(last.sigma_um, last.tip_sigma_um)
        if abs(further) < allowance / _TOGETHER and self._moving < _LONGEST:
            return "undecided"
        along = abs(last.tip_um - begun.tip_um - further) < _TOGETHER * abs(further) + allowance
        # Until the touch the tip may come any way, but not less than the specimen has gone since.
        came = last.tip_um - first.tip_um > (1.0 - _TOGETHER) * risen - allowance
        return "along" if along and came else "otherwise"

    def _recent(self) -> list[DeformationSample]:
        """The samples since the sum left zero."""
        return [self._samples[k] for k in range(len(self._samples) - self._moving, len(self._samples))]

    def _rest(self, resting: int) -> tuple[float, float]:
        """Mean deformation before the newest rise, and its standard deviation."""
        count = max(_REST_FRAMES, resting - _REST_GAP)
        values = np.array([self._samples[k].deformation_um for k in range(count)])
        sigmas = np.array([self._samples[k].sigma_um for k in range(count)])
        return float(values.mean()), float(np.sqrt(np.mean(sigmas**2) / count))

    def _place(self, rest: float, rest_sigma: float) -> ContactEvent:
        """The touch: where deformation = max(0, tip − place) fits best."""
        recent = self._recent()
        tip = np.array([sample.tip_um for sample in recent])
        deformation = np.array([sample.deformation_um for sample in recent]) - rest
        variance = np.array([sample.sigma_um**2 + sample.tip_sigma_um**2 for sample in recent])
        place = float((tip - deformation)[deformation > _BEGUN * deformation[-1]].mean())
        after = tip > place
        for _ in range(_ROUNDS):
            weights = after / variance
            place = float((weights * (tip - deformation)).sum() / weights.sum())
            if np.array_equal(after, tip > place) or not np.any(tip > place):
                break
            after = tip > place
        first = int(np.argmax(after))
        t_ns, sigma_s = _time(recent[first:], deformation[first:], rest_sigma)
        return ContactEvent(
            t_ns=t_ns,
            sigma_s=sigma_s,
            tip_um=place,
            tip_sigma_um=math.hypot(1.0 / math.sqrt(float(weights.sum())), rest_sigma),
            deformation_um=rest,
            deformation_sigma_um=rest_sigma,
            frame_seq=recent[first].frame_seq,
            frames=int(after.sum()),
        )


def _time(touching: list[DeformationSample], deformation_um: FloatArray, rest_sigma_um: float) -> tuple[int, float]:
    """Where a line through the first deformations after the touch meets zero, and its standard deviation in s."""
    start_ns = touching[0].t_ns
    t_s = np.array([(sample.t_ns - start_ns) / NS_PER_S for sample in touching])
    sigma = np.array([sample.sigma_um for sample in touching])
    if len(touching) < 3 or not np.ptp(t_s) > 0.0:
        return start_ns, math.nan
    design = np.stack([np.ones_like(t_s), t_s]) / sigma
    covariance = np.linalg.inv(design @ design.T)
    level, speed = (covariance @ design @ (deformation_um / sigma)).tolist()
    if not speed > _MOVING_SIGMAS * math.sqrt(covariance[1, 1]):
        return start_ns, math.nan
    squares = float((((deformation_um - level - speed * t_s) / sigma) ** 2).sum())
    covariance = covariance * max(1.0, squares / (len(touching) - 2))
    before_s = -level / speed
    gradient = np.array([1.0, before_s])
    variance = float(gradient @ covariance @ gradient) + rest_sigma_um**2
    return start_ns + round(before_s * NS_PER_S), math.sqrt(variance) / speed
