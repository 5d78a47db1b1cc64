"""One indentation as recorded, and what makes it unusable."""

from __future__ import annotations

import math
from numbers import Real
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from microdrivers.core.errors import DataError, NoContact, SaturatedData, TargetLost
from microdrivers.estimators.force.model import Array
from microdrivers.estimators.force.real_arrays import real_array

Mask = npt.NDArray[np.bool_]

FEWEST_SAMPLES = 20
LONGEST_GAP = 10.0
"""Of the median interval between samples."""

FLAT_RUN = 5
"""Samples at one and the same extreme force that are taken for a sensor at the end of its range."""

CLEAR = 6.0
"""Standard deviations that are no noise."""

_SHORTEST_STEP_S, _LONGEST_STEP_S = 2e-5, 5.0
_SOFTEST_PA, _HARDEST_PA = 150.0, 1e9
_LARGEST_FORCE_UN = 1e5
_PA_PER_UN_UM2 = 1e6
_STATED_OVER_OBSERVED_NOISE = (300.0, 3000.0)
"""Of a force in mN whose noise is stated in µN."""

_OUTERMOST, _CLEARLY_TOGETHER = 0.2, 0.5
"""Share of the deformation's range in which no force is largest; correlation of force and deformation that is clear."""

_PRESSED_AGAIN, _LET_GO, _CAME_BACK = 0.5, 0.25, 0.3
"""Shares: of the force's range above which a tool presses, and below which it has let go; of the deformation's range by
which it must have come back in between."""

_FEW_LEVELS = 1.0 / 3.0
"""Of the number of samples: so few different values are rounded ones."""

_USABLE_SHARE = 0.5
_PRESSES = 0.02
_UNITS = "give time_s in s, deformation in µm and force in µN (1 mN is 1000 µN)"


class IndentationRecord(NamedTuple):
    """One indentation: approach, loading, hold if any, unloading; equal lengths.

    Attributes:
        time_s: instants of the frames, increasing.
        deformation_um: of the contact point, positive into the specimen. NaN only where `lost`.
        force_uN: mean of the sensor's force over each frame's exposure, positive while it is pressed, tared.
        deformation_sigma_um: standard deviation of a deformation, white; 0 or NaN if unknown.
        force_sigma_uN: standard deviation of a force, white; 0 or NaN if unknown.
        lost: where the contact point was not seen or the force not valid; None if nowhere.
        saturated: where the sensor said that it was at the end of its range; None if nowhere.
    """

    time_s: Array
    deformation_um: Array
    force_uN: Array
    deformation_sigma_um: float = 0.0
    force_sigma_uN: float = 0.0
    lost: Mask | None = None
    saturated: Mask | None = None


def lost(record: IndentationRecord) -> Mask:
    """Where the record says that nothing was measured."""
    return np.zeros(len(record.time_s), dtype=bool) if record.lost is None else np.asarray(record.lost, dtype=bool)


def saturated(record: IndentationRecord) -> Mask:
    """Where the sensor was at the end of its range: as it said, and where an extreme force repeats exactly."""
    said = lost(record) & False if record.saturated is None else np.asarray(record.saturated, dtype=bool)
    force = np.where(lost(record), np.nan, record.force_uN)
    found = said.copy()
    largest = np.nanmax(np.abs(force), initial=0.0)
    for extreme in (largest, -largest):
        at = force == extreme
        # A run of equal readings next to each other; a coarse sensor repeats, but not for long while it is pressed.
        for first, last in runs(at):
            if last - first >= FLAT_RUN and largest > 0.0:
                found[first:last] = True
    return found


def runs(mask: Mask) -> list[tuple[int, int]]:
    """Half-open index ranges where a mask holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def white_sigma(values: Array) -> float:
    """Standard deviation of the white noise on a smooth curve, from third differences; robust against its kinks.

    At least that of the rounding, where few levels repeat.
    """
    third = np.diff(values, 3)
    third = third[np.isfinite(third)]
    if len(third) < FEWEST_SAMPLES // 2:
        return float("nan")
    # Third differences of white noise have variance 20; the median of |normal| is 0.6745 standard deviations.
    seen = float(np.median(np.abs(third)) / 0.6745 / np.sqrt(20.0))
    levels = np.unique(values[np.isfinite(values)])
    rounded = 1 < len(levels) < _FEW_LEVELS * len(values)
    return max(seen, float(np.min(np.diff(levels))) / np.sqrt(12.0)) if rounded else seen


def medians_of_five(values: Array) -> Array:
    """Medians of five, two samples shorter at either end: a single outlier is no contact and no reversal."""
    smooth: Array = np.median(np.lib.stride_tricks.sliding_window_view(values, 5), axis=1)
    return smooth


def check(record: IndentationRecord) -> IndentationRecord:
    """Refuse what cannot be an indentation.

    A stretch that is marked `lost` or `saturated` is no error: it is left out later.

    Returns:
        The record with its columns as arrays of floats: lists will do, and what a masked array masks is NaN.

    Raises:
        DataError: values that are not real numbers, noise that is negative or infinite, wrong shapes, too short, time
            not increasing, a gap, NaN, constant force, implausible units, wrong sign.
        NoContact: the force never leaves its noise.
        SaturatedData: most of the record is at the end of the sensor's range.
        TargetLost: the contact point was lost in most of the record.
    """
    record = _in_floats(record)
    _check_shapes(record)
    _check_time(record.time_s)
    unseen = lost(record)
    if np.mean(unseen) > _USABLE_SHARE:
        raise TargetLost(
            f"the contact point or the force was lost in {np.sum(unseen)} of {len(unseen)} samples",
            remedy="check focus, light and texture at the contact point, and the sensor; then indent again",
        )
    for name, values in (("deformation_um", record.deformation_um), ("force_uN", record.force_uN)):
        bad = np.flatnonzero(~np.isfinite(values) & ~unseen)
        if len(bad):
            raise DataError(
                f"{name} is not a number in {len(bad)} samples, first at {record.time_s[bad[0]]:.3f} s",
                remedy="mark the samples as lost, or record again",
            )
    _check_signs(record, unseen)
    _check_force(record, unseen)
    _check_units(record, unseen)
    _check_one(record, unseen)
    return record


def _in_floats(record: IndentationRecord) -> IndentationRecord:
    for name in ("deformation_sigma_um", "force_sigma_uN"):
        sigma = getattr(record, name)
        if not isinstance(sigma, Real) or sigma < 0.0 or math.isinf(sigma):
            raise DataError(
                f"{name} is {sigma!r}", remedy="give a standard deviation of 0 or more, or NaN where it is not known"
            )
    return record._replace(
        time_s=real_array(record.time_s, what="time_s"),
        deformation_um=real_array(record.deformation_um, what="deformation_um"),
        force_uN=real_array(record.force_uN, what="force_uN"),
    )


def _check_shapes(record: IndentationRecord) -> None:
    columns = (record.time_s, record.deformation_um, record.force_uN, record.lost, record.saturated)
    shapes = [np.shape(column) for column in columns if column is not None]
    n = record.time_s.size
    if any(shape != (n,) for shape in shapes):
        raise DataError(
            f"the columns of the record differ in length: {', '.join(map(str, shapes))}",
            remedy="give one value of each column a sample",
        )
    if n < FEWEST_SAMPLES:
        raise DataError(
            f"the record has {n} samples; at least {FEWEST_SAMPLES} are needed",
            remedy="indent deeper or more slowly, or record at a higher rate",
        )


def _check_time(time_s: Array) -> None:
    if not np.all(np.isfinite(time_s)):
        raise DataError("time_s is not a number in places", remedy="every sample needs its time, in s")
    step = np.diff(time_s)
    back = np.flatnonzero(step <= 0.0)
    if len(back):
        raise DataError(
            f"time does not increase after {time_s[back[0]]:.6f} s (sample {back[0]}), and {len(back)} times in all",
            remedy="sort the record and remove repeated samples",
        )
    usual = float(np.median(step))
    if not _SHORTEST_STEP_S <= usual <= _LONGEST_STEP_S:
        raise DataError(f"implausible units: samples come every {usual:.4g} s", remedy=_UNITS)
    longest = int(np.argmax(step))
    if step[longest] > LONGEST_GAP * usual:
        raise DataError(
            f"gap of {step[longest]:.3f} s after {time_s[longest]:.3f} s; samples come every {usual:.4f} s",
            remedy="record again without dropped frames, or keep the frames and mark them as lost",
        )


def _check_force(record: IndentationRecord, unseen: Mask) -> None:
    force = record.force_uN[~unseen]
    if np.ptp(force) == 0.0:
        raise DataError(
            f"the force is constant, {force[0]:.6g} µN",
            remedy="check that the sensor is connected, in range and read during the indentation",
        )
    full = saturated(record)
    if np.mean(full) > _USABLE_SHARE:
        raise SaturatedData(
            f"the sensor is at the end of its range ({record.force_uN[full][0]:.6g} µN) in {np.sum(full)} of "
            f"{len(full)} samples",
            remedy="indent less deeply, or use a sensor with a wider range",
        )
    observed, noise = white_sigma(force), _larger_of_stated_and_seen(record.force_sigma_uN, force)
    low, high = (share * observed for share in _STATED_OVER_OBSERVED_NOISE)
    if low < record.force_sigma_uN < high:
        raise DataError(
            f"implausible units: the force has noise of {observed:.3g} µN, stated is {record.force_sigma_uN:.3g} µN",
            remedy=_UNITS,
        )
    smooth = medians_of_five(force)
    if np.ptp(smooth) < CLEAR * noise:
        raise NoContact(
            f"no contact: the force varies by {np.ptp(smooth):.3g} µN over the whole travel, noise is {noise:.3g} µN",
            remedy="check that the probe reaches the specimen, the height and aim of the probe, and the sensor",
        )
    pulls = smooth.max() - smooth[0] < smooth[0] - smooth.min() and smooth.min() < -CLEAR * noise
    if pulls and not _starts_deep(record, unseen):
        raise DataError(
            f"the specimen pulls: the force goes from {smooth[0]:.4g} down to {smooth.min():.4g} µN",
            remedy="forces are positive while the probe is pressed: change the sign of force_uN, or turn the sensor's "
            "axis round in the rig file",
        )


def _check_signs(record: IndentationRecord, unseen: Mask) -> None:
    """Whether the deformation grows where the force does, and both are positive."""
    force, deformation = medians_of_five(record.force_uN[~unseen]), medians_of_five(record.deformation_um[~unseen])
    if min(np.ptp(force), np.ptp(deformation)) == 0.0:
        return
    together = float(np.corrcoef(force, deformation)[0, 1])
    hardest = int(np.argmax(np.abs(force - force[0])))
    place = (deformation[hardest] - deformation.min()) / np.ptp(deformation)
    if place > _OUTERMOST or abs(together) < _CLEARLY_TOGETHER:
        return
    at = f"the force of {force[hardest]:.4g} µN belongs to an indentation of {deformation[hardest]:.4g} µm"
    if together < 0.0 and force[hardest] > force[0]:
        raise DataError(
            f"the deformation is reversed: it falls while the force rises, and {at}",
            remedy="the deformation is positive into the specimen: change the sign of indentation_um",
        )
    if together > 0.0 and force[hardest] < min(force[0], 0.0) and -force.min() > force.max():
        raise DataError(
            f"force and deformation are reversed: both fall, and {at}",
            remedy="both are positive while the probe is pressed: change the signs of force_uN and indentation_um",
        )


def _check_one(record: IndentationRecord, unseen: Mask) -> None:
    """Whether the record holds one indentation: the force does not rise again after the tool has come back."""
    time_s = record.time_s[~unseen][2:-2]
    force, deformation = medians_of_five(record.force_uN[~unseen]), medians_of_five(record.deformation_um[~unseen])
    level = (force - force.min()) / np.ptp(force)
    way = (deformation - deformation.min()) / np.ptp(deformation)
    tops: list[int] = []
    between: list[int] = []
    for first, last in runs(level > _PRESSED_AGAIN):
        top = first + int(np.argmax(force[first:last]))
        if tops:
            low = tops[-1] + int(np.argmin(level[tops[-1] : first + 1]))
            back = float(way[tops[-1] : first + 1].min())
            if level[low] > _LET_GO or min(way[tops[-1]], way[top]) - back < _CAME_BACK:
                continue
            between.append(low)
        tops.append(top)
    if between:
        cuts = ", ".join(f"{time_s[low]:.2f} s" for low in between)
        raise DataError(
            f"the record holds {len(tops)} indentations: it presses again after {cuts}",
            remedy=f"cut it at {cuts}, and analyse each part by itself",
        )


def _starts_deep(record: IndentationRecord, unseen: Mask) -> bool:
    """The record begins at the deepest point: unloading alone, where the force goes down."""
    deformation = record.deformation_um[~unseen]
    return bool(deformation[0] > np.median(deformation))


def _check_units(record: IndentationRecord, unseen: Mask) -> None:
    deformation, force = record.deformation_um[~unseen], record.force_uN[~unseen]
    depth = float(np.ptp(deformation))
    if depth < CLEAR * _larger_of_stated_and_seen(record.deformation_sigma_um, deformation) or depth == 0.0:
        raise DataError(
            f"the deformation varies by {depth:.3g} µm only, which is its noise",
            remedy="check that the contact point is followed, and that its deformation (indentation_um) is in µm",
        )
    largest = float(np.max(np.abs(force)))
    # Of the way, only where it presses: a tip may come from far.
    pressed = deformation[force - force[0] > _PRESSES * np.ptp(force)]
    depth = float(np.ptp(pressed)) if len(pressed) > 1 else depth
    stiffness_Pa = float(np.ptp(force)) / max(depth, 1e-9) ** 2 * _PA_PER_UN_UM2
    if not _SOFTEST_PA <= stiffness_Pa <= _HARDEST_PA:
        raise DataError(
            f"implausible units: {np.ptp(force):.4g} µN at {depth:.4g} µm is a modulus (force over depth squared) of "
            f"{stiffness_Pa:.3g} Pa; soft matter has {_SOFTEST_PA:g} Pa to {_HARDEST_PA:g} Pa",
            remedy=_UNITS,
        )
    if largest > _LARGEST_FORCE_UN:
        raise DataError(f"implausible units: a force of {largest:.4g} µN", remedy=_UNITS)


def _larger_of_stated_and_seen(stated: float, values: Array) -> float:
    observed = white_sigma(values)
    return max(stated if np.isfinite(stated) else 0.0, observed if np.isfinite(observed) else 0.0)
