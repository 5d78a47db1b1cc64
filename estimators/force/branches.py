"""Where an indentation touches, turns and lets go: the branches of a record."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from microdrivers.core.errors import NoContact
from microdrivers.estimators.force.departure import Departure, find_departure
from microdrivers.estimators.force.drift import CLEAR_SLOPE, straight_drift
from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.record import CLEAR, medians_of_five

BRANCH_NAMES = ("approach", "loading", "hold", "unloading", "lost")

_BASELINE = 30
"""Samples before a contact that tell its baseline."""

_FEWEST_AT_REST = 8
_TURN_SHARE = 0.5
"""Of a branch's usual speed: what is slower turns round or holds."""

_SLOPE_NOISE = 0.12
"""Of the usual speed: what a local slope may scatter."""

_WIDEST_SLOPE = 8
_LINE_SAMPLES = 25
_SHORTEST_LINE = 8
_SHORTEST_HOLD = 8
_SHORTEST_LOSS = 3
_STARTS_IN_CONTACT = 0.05
"""Growth of the force before the contact, relative to that while loading, which is more than a sensor's drift."""


class Branches(NamedTuple):
    """Index ranges of one indentation, in order and without holes; empty where there is none.

    Attributes:
        approach: out of contact, before. loading: the deformation grows. hold: it stays. unloading: it shrinks.
        lost: out of contact again.
        onset_s: the last instant without a force for sure and the first with one; None if the record begins in contact.
        turns_s: instants of the reversals: one without a hold, two with it, none if the record ends before.
        release_s: the last instant with a force for sure and the first without; None if the record ends before.
    """

    approach: range
    loading: range
    hold: range
    unloading: range
    lost: range
    onset_s: tuple[float, float] | None
    turns_s: tuple[float, ...]
    release_s: tuple[float, float] | None

    @property
    def released_s(self) -> float | None:
        """When contact was lost, as far as that is known; None if the record ends before."""
        return None if self.release_s is None else sum(self.release_s) / 2.0

    def labels(self) -> list[str]:
        """Name of the branch of every sample."""
        return [name for name in BRANCH_NAMES for _ in getattr(self, name)]


def find_branches(
    time_s: Array, deformation_um: Array, force_uN: Array, *, deformation_sigma_um: float, force_sigma_uN: float
) -> Branches:
    """Split one indentation.

    The contact is where the force leaves its baseline, the reversals are where straight lines through the deformation
    on either side meet, and contact is lost where the force returns to the baseline for good, be it before a reversal.
    A drift that both ends of the record agree on is taken off first.

    Args:
        time_s: increasing.
        deformation_um: finite throughout.
        force_uN: finite throughout.
        deformation_sigma_um: noise.
        force_sigma_uN: noise.

    Raises:
        NoContact: the force does not rise.
    """
    n = len(time_s)
    drift = straight_drift(time_s, force_uN, force_sigma_uN)
    force_uN = force_uN if drift is None else force_uN - drift.at(time_s)
    peak = int(np.argmax(medians_of_five(np.pad(deformation_um, 2, mode="edge"))))
    onset = _onset(time_s, force_uN, force_sigma_uN)
    first = onset.early
    peak = max(peak, first + 1)
    if peak >= n or force_uN[first : peak + 3].max() - force_uN[max(first - 1, 0)] < CLEAR * force_sigma_uN:
        raise NoContact(
            "the force does not rise while the deformation grows",
            remedy="check the sensor's axis and sign, and that the record holds the loading",
        )
    turns = _turns(time_s, deformation_um, first, peak, deformation_sigma_um)
    load_end = int(np.searchsorted(time_s, turns[0])) if turns else n
    hold_end = int(np.searchsorted(time_s, turns[-1])) if turns else n
    if len(turns) == 1 and _holds(time_s, deformation_um, first, load_end):
        hold_end = n
    going, gone = _loss(time_s, force_uN, first, hold_end, force_sigma_uN)
    if gone == hold_end < n:
        slipping, slipped_off = _loss(time_s, force_uN, first, first, force_sigma_uN)
        if slipped_off < hold_end:
            going, gone = slipping, slipped_off
            hold_end, load_end = min(hold_end, gone), min(load_end, gone)
    return Branches(
        approach=range(first),
        loading=range(first, load_end),
        hold=range(load_end, hold_end),
        unloading=range(hold_end, gone),
        lost=range(gone, n),
        onset_s=(float(time_s[first - 1]), float(time_s[onset.late])) if first else None,
        turns_s=turns,
        release_s=(float(time_s[going - 1]), float(time_s[gone])) if gone < n else None,
    )


def _onset(time_s: Array, force: Array, sigma: float) -> Departure:
    """The first sample in contact; 0 if the record begins there."""
    found = find_departure(force, sigma)
    if found is None:
        return Departure(0, 0)
    first = found.early
    top = int(np.argmax(force))
    growth = (force[top] - force[first]) / (time_s[top] - time_s[first]) if top > first else 0.0
    return Departure(0, 0) if _is_loaded(time_s[:first], force[:first], growth, sigma) else found


def _is_loaded(time_s: Array, force: Array, growth_uN_s: float, sigma: float) -> bool:
    """Whether a force that should be at rest grows as one in contact does."""
    slope = float(np.polynomial.polynomial.polyfit(time_s, force, 1)[1])
    by_noise = sigma / float(np.std(time_s) * np.sqrt(len(time_s)))
    return slope > max(_STARTS_IN_CONTACT * growth_uN_s, CLEAR_SLOPE * by_noise)


def _speeds(time_s: Array, deformation: Array, usual_um_s: float, sigma: float) -> Array:
    """Local slopes of straight lines, over the narrowest window that their noise allows."""
    step = float(np.median(np.diff(time_s)))
    half = 1
    while half < _WIDEST_SLOPE and sigma * np.sqrt(3.0 / (half * (half + 1) * (2 * half + 1))) > (
        _SLOPE_NOISE * usual_um_s * step
    ):
        half += 1
    i = np.arange(len(time_s))
    reach = np.arange(-half, half + 1)
    at = np.clip(i[:, None] + reach, 0, len(time_s) - 1)
    t, x = time_s[at], deformation[at]
    t = t - t.mean(axis=1, keepdims=True)
    slopes: Array = (t * x).sum(axis=1) / (t * t).sum(axis=1)
    return slopes


def _turns(time_s: Array, deformation: Array, first: int, peak: int, sigma: float) -> tuple[float, ...]:
    usual = (deformation[peak] - deformation[first]) / (time_s[peak] - time_s[first])
    speed = _speeds(time_s, deformation, abs(float(usual)), sigma)
    loading = float(np.median(speed[first : peak + 1]))
    in_motion = np.flatnonzero(speed[first : peak + 1] > _TURN_SHARE * loading)
    if not len(in_motion):
        return ()
    load_last = first + int(in_motion[-1])
    falling = speed[peak:][speed[peak:] < -_TURN_SHARE * loading]
    back = float(np.median(falling)) if len(falling) else -loading
    turned = np.flatnonzero(speed[load_last:] < _TURN_SHARE * back)
    if not len(turned):
        ends_here = len(time_s) - 1 - load_last < _SHORTEST_HOLD
        return () if ends_here else (_meeting(time_s, deformation, first, load_last, load_last, len(time_s) - 1),)
    unload_first = load_last + int(turned[0])
    last = len(time_s) - 1
    if unload_first - load_last < _SHORTEST_HOLD:
        return (_meeting(time_s, deformation, first, load_last, unload_first, last),)
    return (
        _meeting(time_s, deformation, first, load_last, load_last, unload_first),
        _meeting(time_s, deformation, load_last, unload_first, unload_first, last),
    )


def _meeting(time_s: Array, deformation: Array, first: int, end: int, begin: int, last: int) -> float:
    """Instant at which lines through the samples up to `end` and from `begin` on meet, between the two or close by."""
    if min(end - first, last - begin) < _SHORTEST_LINE:
        # Too short for a line, and perhaps of changing speed: right after the deepest sample.
        deepest = end + int(np.argmax(deformation[end : begin + 1]))
        return float(time_s[deepest] + time_s[min(deepest + 1, last)]) / 2.0
    margin = min(3, (end - first) // 4, (last - begin) // 4)
    left = slice(max(first, end - margin - _LINE_SAMPLES), end - margin + 1)
    right = slice(begin + margin, min(last, begin + margin + _LINE_SAMPLES) + 1)
    middle = float(time_s[end] + time_s[begin]) / 2.0
    fit = np.polynomial.polynomial.polyfit
    if left.stop - left.start < 2 or right.stop - right.start < 2:
        return middle
    a = fit(time_s[left] - middle, deformation[left], 1)
    b = fit(time_s[right] - middle, deformation[right], 1)
    reach = float(time_s[min(begin + margin, last)] - time_s[max(end - margin, first)]) / 2.0
    return middle + float(np.clip((b[0] - a[0]) / (a[1] - b[1]), -reach, reach)) if a[1] != b[1] else middle


def _holds(time_s: Array, deformation: Array, first: int, turn: int) -> bool:
    """The record ends in a hold: after its only reversal the deformation stays within a fifth of the depth."""
    depth = float(deformation[turn - 1] - deformation[first])
    return bool(len(time_s) > turn and np.median(deformation[turn:]) > deformation[turn - 1] - 0.2 * depth
                and deformation[-3:].mean() > deformation[turn - 1] - 0.1 * depth)  # fmt: skip


def _loss(time_s: Array, force: Array, first: int, begin: int, sigma: float) -> tuple[int, int]:
    """First and last sample that may be the first at the baseline again, however that drifts; their number if none."""
    n = len(force)
    tail = force[-_FEWEST_AT_REST:]
    if begin >= n or np.ptp(tail) > 2.0 * CLEAR * sigma or n - begin <= _FEWEST_AT_REST:
        at_rest = float(np.mean(force[max(first - _BASELINE, 0) : max(first - 1, 1)])) if first else 0.0
        pressed = np.flatnonzero(np.abs(force[begin:] - at_rest) > CLEAR * sigma)
        gone = begin + (int(pressed[-1]) + 1 if len(pressed) else 0)
        gone = gone if n - gone >= _SHORTEST_LOSS else n
        return gone, gone
    found = find_departure(force[begin:][::-1], sigma)
    if found is None:
        # The median: around the reversal some frames may still have felt the specimen.
        fallen_uN = np.median(force[begin : begin + _FEWEST_AT_REST]) - np.mean(tail)
        return (n, n) if fallen_uN > CLEAR * sigma else (begin, begin)
    going, gone = n - found.late, n - found.early
    fall = (force[begin] - force[gone - 1]) / (time_s[gone - 1] - time_s[begin]) if gone - 1 > begin else 0.0
    if _is_loaded(-time_s[gone:][::-1], force[gone:][::-1], fall, sigma):
        return n, n
    return going, gone
