"""A record made ready for fits: noise, branches, baseline, what is left out and why, what is known of the contact."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import DataError, SaturatedData
from microdrivers.estimators.force.branches import Branches, find_branches
from microdrivers.estimators.force.drift import CLEAR_SLOPE, SHORTEST_BASELINE, Baseline, is_step, line_through
from microdrivers.estimators.force.joint import BASE, CONTACT, CONTACT_S, PARAMETERS, Prior
from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.record import IndentationRecord, Mask, lost, saturated, white_sigma

Indices = npt.NDArray[np.int64]
SeenBefore = Literal["surface", "tip", "nothing"]

LOADING, HOLD, UNLOADING = 0, 1, 2
"""Numbers of the branches in contact."""

_FEWEST_IN_FIT = 10
"""Samples of the loading: with fewer a fit says nothing."""

_MOSTLY = 0.5
"""Of the loading's samples: if more are saturated, that is why too few are left."""

_NOISE_SCATTER = 5.0
"""Three relative standard deviations of an observed noise, times the root of the number of samples."""

_LARGEST_SHARE = 0.2
"""Of a branch's samples: what may be left out at either end."""

_MOVES = 0.5
"""Of the loading speed: what moves at that before the contact is the tool, not the specimen."""

_SHORTEST_HOLD_S = 1.0
"""What stays for less is a stage that turns round slowly."""

_TIP_SAMPLES = 30
"""Before the contact, that tell whether the deformation follows the tool and how."""


class ContactKnowledge(NamedTuple):
    """What is known of the contact apart from the fit.

    Attributes:
        seen: what the deformation followed before the contact: the undeformed surface, the tool's tip, or nothing
            since the record begins in contact.
        contact_um: where the surface is. contact_s: when it was touched, from the force alone.
        sigma_um: standard deviation of `contact_um` (surface), or of the tip's line at a given instant (tip).
        sigma_s: standard deviation of `contact_s`; 0 if it is not observed at all.
        speed_um_s: of the tip before the contact; 0 if the surface was seen.
    """

    seen: SeenBefore
    contact_um: float
    contact_s: float
    sigma_um: float
    sigma_s: float
    speed_um_s: float

    def priors(self) -> list[Prior]:
        """The same as priors on the parameters."""
        at, when = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
        at[CONTACT], when[CONTACT_S] = 1.0, 1.0
        if self.seen == "nothing":
            return [Prior(at, self.contact_um, self.sigma_um)]
        at[CONTACT_S] = -self.speed_um_s
        line = self.contact_um - self.speed_um_s * self.contact_s
        return [Prior(at, line, self.sigma_um), Prior(when, self.contact_s, self.sigma_s)]


class Margins(NamedTuple):
    """Time left out of loading, hold and unloading: at the beginning, and at the end."""

    begin_s: tuple[float, ...]
    end_s: tuple[float, ...]

    @classmethod
    def same(cls, margin_s: float) -> Margins:
        """The same at all ends."""
        return cls((margin_s,) * 3, (margin_s,) * 3)


class Prepared(NamedTuple):
    """A record without its baseline, and what is used of it.

    Attributes:
        time_s, deformation_um, force_uN: all samples; the baseline is taken off the force.
        measured: where deformation and force were measured.
        deformation_sigma_um, force_sigma_uN: noise, as stated or, if that is more, as observed.
        branches: of the record.
        used: indices of the samples that fits may use, in order. branch: number of the branch of each.
        excluded: reason → indices of the other samples.
        contact: what is known of it before any fit.
        baseline: what was taken off; None where there was none to see.
        frame_s: usual interval of samples.
        depth_um: range of the deformation.
    """

    time_s: Array
    deformation_um: Array
    force_uN: Array
    measured: Mask
    deformation_sigma_um: float
    force_sigma_uN: float
    branches: Branches
    used: Indices
    branch: Indices
    excluded: dict[str, Indices]
    contact: ContactKnowledge
    baseline: Baseline | None
    frame_s: float
    depth_um: float

    @property
    def baseline_uN(self) -> Array:
        """What was taken off the force of every sample."""
        return np.zeros_like(self.time_s) if self.baseline is None else self.baseline.at(self.time_s)

    def priors(self) -> list[Prior]:
        """What is known of contact and baseline apart from the samples in contact."""
        row = np.zeros(PARAMETERS)
        row[BASE] = 1.0
        base = [Prior(row, 0.0, self.baseline.sigma_level_uN)] if self.baseline is not None else []
        return self.contact.priors() + base


def prepare(record: IndentationRecord, *, around_reversal: int, margins: Margins) -> Prepared:
    """Make a checked record ready.

    Args:
        record: one that `check` accepts.
        around_reversal: samples left out on either side of contact, reversals and release.
        margins: left out besides, where the motion has not settled.

    Raises:
        DataError: too few samples are left. NoContact: the force does not rise. SaturatedData: hardly a sample of
            the loading lies within the sensor's range.
    """
    time_s = np.asarray(record.time_s, dtype=np.float64)
    full, unseen = saturated(record), lost(record)
    measured = ~(full | unseen)
    deformation, force = (
        np.interp(time_s, time_s[measured], np.asarray(values, dtype=np.float64)[measured])
        for values in (record.deformation_um, record.force_uN)
    )
    sigma_x = _stated_unless_exceeded(record.deformation_sigma_um, deformation[measured])
    sigma_f = _stated_unless_exceeded(record.force_sigma_uN, force[measured])
    branches = find_branches(time_s, deformation, force, deformation_sigma_um=sigma_x, force_sigma_uN=sigma_f)
    frame_s = float(np.median(np.diff(time_s)))
    baseline = _baseline(time_s, force, branches, measured, sigma_f, around_reversal)
    reasons = {
        "before contact": _mask(len(time_s), branches.approach),
        "after the tip had left": _mask(len(time_s), branches.lost),
        "not measured": unseen,
        "saturated": full,
        **_turning(time_s, branches, around_reversal, margins),
    }
    excluded, used = _parted(reasons, len(time_s))
    branch = _branch_numbers(branches, len(time_s))[used]
    _require_loading(int(np.sum(branch == LOADING)), full[branches.loading.start : branches.loading.stop])
    return Prepared(
        time_s=time_s,
        deformation_um=deformation,
        force_uN=force if baseline is None else force - baseline.at(time_s),
        measured=measured,
        deformation_sigma_um=sigma_x,
        force_sigma_uN=sigma_f,
        branches=branches,
        used=used,
        branch=branch,
        excluded=excluded,
        contact=_contact(time_s, deformation, force, branches, sigma_x, sigma_f, frame_s, around_reversal),
        baseline=baseline,
        frame_s=frame_s,
        depth_um=float(np.ptp(deformation)),
    )


def _parted(reasons: Mapping[str, Mask], samples: int) -> tuple[dict[str, Indices], Indices]:
    """Samples that are left out, by the first reason that holds for each, and the others."""
    excluded, free = {}, np.ones(samples, dtype=bool)
    for reason, mask in reasons.items():
        if np.any(mask & free):
            excluded[reason] = np.flatnonzero(mask & free)
        free &= ~mask
    return excluded, np.flatnonzero(free)


def _branch_numbers(branches: Branches, samples: int) -> Indices:
    """Number of the branch of every sample; −1 out of contact."""
    number = np.full(samples, -1)
    for index, part in ((LOADING, branches.loading), (HOLD, branches.hold), (UNLOADING, branches.unloading)):
        number[part.start : part.stop] = index
    return number


def _require_loading(usable: int, full: Mask) -> None:
    """Refuse a loading with too few samples for a fit; `full`: where in it the sensor was at the end of its range."""
    if usable >= _FEWEST_IN_FIT:
        return
    if np.count_nonzero(full) > _MOSTLY * len(full):
        raise SaturatedData(
            f"the sensor is at the end of its range nearly throughout the loading, and {usable} samples are left",
            remedy="indent less deeply or more slowly, or use a sensor with a wider range",
        )
    raise DataError(
        f"{usable} samples of the loading are usable, at least {_FEWEST_IN_FIT} are needed",
        remedy="indent deeper or more slowly, or record at a higher rate",
    )


def _stated_unless_exceeded(stated: float, values: Array) -> float:
    """Stated noise, unless more of it is seen; a trace of the values' range where there is none at all."""
    stated = stated if np.isfinite(stated) else 0.0
    observed = white_sigma(values)
    # The observation itself scatters: only what is clearly more overrules a statement.
    clearly = 1.0 + _NOISE_SCATTER / np.sqrt(len(values))
    found = observed if np.isfinite(observed) and observed > clearly * stated else stated
    return float(max(found, 1e-9 * np.ptp(values)))


def _mask(n: int, part: range) -> Mask:
    mask = np.zeros(n, dtype=bool)
    mask[part.start : part.stop] = True
    return mask


def _turning(time_s: Array, branches: Branches, around: int, margins: Margins) -> dict[str, Mask]:
    """Samples next to contact, reversals and release, and those about them in which the speed settles."""
    n = len(time_s)
    near, settling = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    parts = (branches.loading, branches.hold, branches.unloading)
    for index, part in enumerate(parts):
        most = int(_LARGEST_SHARE * len(part))
        before_turn = any(len(later) for later in parts[index + 1 :]) or branches.release_s is not None
        begins = index > 0 or branches.onset_s is not None
        count = min(around, max(most, 1))
        if len(part) and begins:
            near[part.start : part.start + count] = True
            if index == 0 and branches.onset_s is not None:
                near[part.start : np.searchsorted(time_s, branches.onset_s[1])] = True
            until = time_s[part.start] + margins.begin_s[index]
            settled = min(int(np.searchsorted(time_s, until)), part.start + most)
            settling[part.start : settled] = True
        if len(part) and before_turn:
            near[max(part.stop - count, part.start) : part.stop] = True
            if branches.release_s is not None and part.stop == branches.lost.start:
                near[max(np.searchsorted(time_s, branches.release_s[0], side="right"), part.start) : part.stop] = True
            since = time_s[part.stop - 1] - margins.end_s[index]
            unsettled = max(int(np.searchsorted(time_s, since, side="right")), part.stop - most)
            settling[unsettled : part.stop] = True
    hold = branches.hold
    if len(hold) and time_s[hold.stop - 1] - time_s[hold.start] < _SHORTEST_HOLD_S:
        near[hold.start : hold.stop] = True
    return {"around contact and reversals": near, "speed not settled": settling}


def _baseline(
    time_s: Array, force: Array, branches: Branches, measured: Mask, sigma: float, around: int
) -> Baseline | None:
    """The force out of contact: a constant, or a line if there is enough of it at both ends and it drifts clearly.

    A zero that has stepped meanwhile is that of before: at least the loading then has its own.
    """
    before = _at_rest(range(branches.approach.start, branches.approach.stop - around), measured)
    after = _at_rest(range(branches.lost.start + around, branches.lost.stop), measured)
    rest, stepped_uN = np.concatenate([before, after]), 0.0
    if not len(rest):
        return None
    if min(len(before), len(after)) >= SHORTEST_BASELINE:
        line = line_through(time_s[rest], force[rest], sigma)
        if line.is_clear:
            if not is_step([(time_s[part], force[part]) for part in (before, after)], line, sigma):
                return line
            rest, stepped_uN = before, float(np.mean(force[after]) - np.mean(force[before]))
    level, sigma_level = float(np.mean(force[rest])), sigma / float(np.sqrt(len(rest)))
    return Baseline(float(np.mean(time_s[rest])), level, sigma_level, 0.0, 0.0, stepped_uN)


def _at_rest(part: range, measured: Mask) -> Indices:
    indices = np.arange(part.start, max(part.stop, part.start))
    kept: Indices = indices[measured[indices]]
    return kept


def _contact(
    time_s: Array, deformation: Array, force: Array, branches: Branches, sigma_x: float, sigma_f: float,
    frame_s: float, around: int,
) -> ContactKnowledge:  # fmt: skip
    loading = branches.loading
    usual = float(
        (deformation[loading.stop - 1] - deformation[loading.start])
        / (time_s[loading.stop - 1] - time_s[loading.start])
    )
    if branches.onset_s is None:
        # It begins in contact: its own zero is the surface, no better than the way of one frame, nor than the way that
        # the force takes which is there already.
        begin = slice(loading.start, loading.start + max(len(loading) // 5, 3))
        slope = float(np.polynomial.polynomial.polyfit(deformation[begin], force[begin], 1)[1])
        pressed = abs(float(force[loading.start])) / slope if slope > 0.0 else 0.0
        sigma = float(np.hypot(usual * frame_s, pressed))
        return ContactKnowledge("nothing", 0.0, float(time_s[0]), sigma, 0.0, 0.0)
    last, first = branches.onset_s
    # A force that rises slowly is noticed late.
    few = force[loading.start : loading.start + 6]
    rise = max(float(few[-1] - few[0]) / (frame_s * max(len(few) - 1, 1)), 1e-12)
    early, late = last - min(6.0 * sigma_f / rise, 5.0 * frame_s), first
    contact_s, sigma_s = float(early + late) / 2.0, float(late - early) / float(np.sqrt(12.0))
    stop = max(branches.approach.stop - around, 2)
    level, sigma, slope, _ = _line(time_s, deformation, max(stop - _TIP_SAMPLES, 0), stop, contact_s, sigma_x)
    if abs(slope) > _MOVES * usual:
        return ContactKnowledge("tip", level, contact_s, sigma, sigma_s, slope)
    level, sigma, slope, slope_sigma = _line(time_s, deformation, 0, stop, contact_s, sigma_x)
    if abs(slope) < CLEAR_SLOPE * slope_sigma:
        level, sigma = float(np.mean(deformation[:stop])), sigma_x / float(np.sqrt(stop))
    # Otherwise the specimen creeps before it is touched: where it was at the contact counts.
    return ContactKnowledge("surface", level, contact_s, sigma, sigma_s, 0.0)


def _line(
    time_s: Array, deformation: Array, start: int, stop: int, at_s: float, noise: float
) -> tuple[float, float, float, float]:
    """Value and slope of a straight line at an instant, each followed by its standard deviation."""
    t = time_s[start:stop] - at_s
    level, slope = np.polynomial.polynomial.polyfit(t, deformation[start:stop], 1)
    spread = np.linalg.inv(np.array([[len(t), t.sum()], [t.sum(), t @ t]])) * noise**2
    return float(level), float(np.sqrt(spread[0, 0])), float(slope), float(np.sqrt(spread[1, 1]))
