"""Figures 9–11 of Bilen et al., section III.C, redrawn from a run. Importing this imports matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from microdrivers.core.protocol_names import ProtocolName
from microdrivers.report.number_format import significant
from microdrivers.report.svg import BLUE, INK, MOVING, ORANGE, SHADE, WIDTH_IN, inline_svg, page_style
from microdrivers.results.force import ForceResult

Array = npt.NDArray[np.float64]

_MOST_POINTS = 1500
_LATE = 0.75
"""Of the time: a peak later than this has its labels on its left."""
_COLOURS = {"approach": MOVING, "loading": BLUE, "hold": INK, "unloading": ORANGE, "lost": MOVING}


class ForceFigures(NamedTuple):
    """SVG elements; `check` is empty without a fresh indentation."""

    trapezoid: str
    reconstructed: str
    slip: str
    check: str


def draw_force_figures(result: ForceResult) -> ForceFigures | None:
    """Draw all figures of a result; None if it holds no sample."""
    if not result.traces.time_s:
        return None
    with page_style():
        return ForceFigures(
            trapezoid=_trapezoid(result),
            reconstructed=_pair(result, "single", "unloading_springs", key="reconstructed"),
            slip=_pair(result, "loading_only", "slip_corrected", key="slip"),
            check=_check(result),
        )


def _trapezoid(result: ForceResult) -> str:
    """Deformation and force over time, and force over deformation."""
    traces = result.traces
    time, depth, force = (_array(values) for values in (traces.time_s, traces.deformation_um, traces.force_uN))
    figure = Figure(figsize=(WIDTH_IN, 3.6))
    grid = figure.add_gridspec(2, 2, left=0.085, right=0.985, bottom=0.13, top=0.93, wspace=0.28, hspace=0.18)
    upper, lower = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    loop = figure.add_subplot(grid[:, 1])
    for axes, values, label in ((upper, depth, "deformation (µm)"), (lower, force, "force (µN)")):
        axes.plot(*_thinned(time, values), color=BLUE)
        axes.set(ylabel=label, xlim=(time[0], time[-1]))
    upper.set(title="(a) over time", xticklabels=[])
    lower.set_xlabel("time (s)")
    _by_branch(loop, result, depth, force)
    loop.set(title="(b) force over deformation", xlabel="deformation (µm)", ylabel="force (µN)")
    return inline_svg(figure, key="trapezoid", label="Deformation and force over time, and force over deformation")


def _by_branch(axes: Axes, result: ForceResult, depth: Array, force: Array) -> None:
    branch = np.array(result.traces.branch)
    axes.margins(y=0.1)
    for name, colour in _COLOURS.items():
        chosen = branch == name
        if not chosen.any():
            continue
        x, y = np.where(chosen, depth, np.nan), np.where(chosen, force, np.nan)
        axes.plot(x, y, color=colour)
        if name in ("loading", "unloading"):
            middle = np.flatnonzero(chosen)[int(0.6 * chosen.sum())]
            side = "right" if name == "loading" else "left"
            offset = (-6, 4) if name == "loading" else (6, -4)
            axes.annotate(
                name, (depth[middle], force[middle]), offset, textcoords="offset points", ha=side,
                va="bottom" if name == "loading" else "top", color=colour, fontweight="bold",
            )  # fmt: skip


def _pair(result: ForceResult, left: ProtocolName, right: ProtocolName, *, key: str) -> str:
    """Measured and fitted force over time for two protocols."""
    traces = result.traces
    time, force = np.array(traces.time_s), _array(traces.force_uN)
    figure = Figure(figsize=(WIDTH_IN, 2.9))
    panels = figure.subplots(1, 2, sharey=True)
    late = time[np.nanargmax(force)] > time[0] + _LATE * (time[-1] - time[0])
    aside, side = (0.025, "left") if late else (0.985, "right")
    figure.subplots_adjust(left=0.085, right=0.985, bottom=0.16, top=0.91, wspace=0.08)
    for axes, name, letter in zip(panels, (left, right), "ab", strict=True):
        axes.set(title=f"({letter}) {name}", xlabel="time (s)", xlim=(time[0], time[-1]))
        axes.plot(*_thinned(time, force), color=INK, linewidth=2.4, alpha=0.3)
        fitted = traces.fitted_uN.get(name)
        if fitted is None or name not in result.protocols:
            axes.text(0.5, 0.5, "not determined", ha="center", transform=axes.transAxes)
            continue
        axes.plot(*_thinned(time, _array(fitted)), color=ORANGE)
        error = f"error {significant(result.protocols[name].error_percent, 3)} %"
        axes.text(aside, 0.95, error, ha=side, va="top", transform=axes.transAxes, color=ORANGE, fontweight="bold")
    panels[0].set_ylabel("force (µN)")
    panels[0].text(aside, 0.86, "measured", ha=side, va="top", transform=panels[0].transAxes, color=MOVING)
    return inline_svg(figure, key=key, label=f"Measured and reconstructed force, {left} and {right}")


def _check(result: ForceResult) -> str:
    """The fresh indentation: the sensor's force, the camera's, and their difference."""
    traces = result.traces
    if not traces.check_time_s:
        return ""
    time, force, vision = np.array(traces.check_time_s), np.array(traces.check_force_uN), _array(traces.check_vision_uN)
    figure = Figure(figsize=(WIDTH_IN, 3.3))
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
    figure.subplots_adjust(left=0.085, right=0.985, bottom=0.14, top=0.97, hspace=0.12)
    upper.plot(*_thinned(time, force), color=INK, linewidth=2.4, alpha=0.3)
    upper.plot(*_thinned(time, vision), color=BLUE)
    upper.text(0.01, 0.95, "sensor", va="top", transform=upper.transAxes, color=MOVING)
    upper.text(0.01, 0.85, "camera alone", va="top", transform=upper.transAxes, color=BLUE, fontweight="bold")
    upper.set_ylabel("force (µN)")
    lower.axhspan(-0.05 * float(np.sqrt(np.mean(force**2))), 0.05 * float(np.sqrt(np.mean(force**2))), color=SHADE)
    lower.plot(*_thinned(time, vision - force), color=BLUE)
    lower.set(ylabel="difference (µN)", xlabel="time (s)", xlim=(time[0], time[-1]))
    return inline_svg(figure, key="check", label="Force of the sensor and of the camera alone in a fresh indentation")


def _thinned(x: Array, y: Array) -> tuple[Array, Array]:
    stride = max(1, -(-len(x) // _MOST_POINTS))
    return x[::stride], y[::stride]


def _array(trace: Sequence[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in trace], dtype=np.float64)
