"""Figures 4–7 of Bilen et al., section III.B, redrawn from a run. Importing this imports matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from microdrivers.report.optics_quantities import settled_index, zoom_name
from microdrivers.report.svg import BLUE, INK, MOVING, MUTED, ORANGE, SHADE, WIDTH_IN, inline_svg, page_style
from microdrivers.results.optics import OpticsResult
from microdrivers.results.record import Trace

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

LIMIT_PX = 0.1
FLOOR_PX = 0.001
"""Errors below are drawn here: the a posteriori error of an exact fit is zero, which has no logarithm."""

_START_UP_FRAMES = 5
_MOST_POINTS = 1000
_FRAMES_BEFORE, _FRAMES_AFTER = 6, 24
_FEW_FRAMES = 80


class OpticsFigures(NamedTuple):
    """SVG elements. `off_scale` says of which figures some values, those of a transient, are not shown."""

    trajectory: str
    projection: str
    error: str
    magnification: str
    off_scale: frozenset[str]


class _Run:
    """A result's traces as arrays, NaN where a value is undefined."""

    def __init__(self, result: OpticsResult) -> None:
        traces = result.traces
        self.result = result
        self.frame: Array = np.array(traces.frame, dtype=np.float64)
        self.moving: Mask = np.array(traces.zoom_moving, dtype=np.bool_)
        self.change = result.zoom_change
        at_rest = ~self.moving
        at_rest[: min(_START_UP_FRAMES, len(at_rest) // 3)] = False
        for index in np.flatnonzero(self.moving):
            at_rest[index : index + _START_UP_FRAMES] = False
        self.trusted: Mask = at_rest
        self.off_scale: set[str] = set()

    def window(self) -> slice:
        """The frames around the zoom change, and until the error has settled."""
        if self.change is None:
            return slice(0, len(self.frame))
        settled = settled_index(self.result) or self.change.last_moving_frame
        last = max(settled, self.change.last_moving_frame) + _FRAMES_AFTER
        return slice(max(self.change.first_frame - _FRAMES_BEFORE, 0), last)

    def after_change(self) -> slice:
        """The frames that the result, and so the truth, stands for."""
        return slice(0 if self.change is None else self.change.last_moving_frame + 1, len(self.frame))


def draw_optics_figures(result: OpticsResult) -> OpticsFigures | None:
    """Draw all figures of a result; None if it holds no frame."""
    if not result.traces.frame:
        return None
    run = _Run(result)
    with page_style():
        trajectory, projection = _trajectory(run), _projection(run)
        error, magnification = _error(run), _magnification(run)
    return OpticsFigures(trajectory, projection, error, magnification, frozenset(run.off_scale))


# ---------------------------------------------------------------------------------------------- figure 4


def _trajectory(run: _Run) -> str:
    traces = run.result.traces
    figure = Figure(figsize=(WIDTH_IN, 3.7))
    image, world = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.09, right=0.985, bottom=0.13, top=0.92, wspace=0.25)
    for axes, x, y in ((image, traces.u_px, traces.v_px), (world, traces.x_um, traces.y_um)):
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.08)
        _path(axes, run, np.array(x), np.array(y))
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
    image.invert_yaxis()
    image.set(title="(a) image", xlabel="u (px)", ylabel="v (px, down)")
    world.set(title="(b) world", xlabel="X (µm)", ylabel="Y (µm)")
    return inline_svg(figure, key="trajectory", label="Trajectory of the tracked point in image and world")


def _path(axes: Axes, run: _Run, x: Array, y: Array) -> None:
    change = run.change
    extent = max(float(np.ptp(x)), float(np.ptp(y)))
    stride = max(1, -(-len(x) // _MOST_POINTS))
    if change is None:
        parts = [(0, len(x), BLUE, "")]
    else:
        first, last = change.first_frame, change.last_moving_frame + 1
        parts = [
            (0, first, BLUE, zoom_name(change.zoom_before)),
            (first, last, MOVING, ""),
            (last, len(x), ORANGE, zoom_name(change.zoom_after)),
        ]
    for start, stop, colour, name in parts:
        axes.plot(x[start:stop:stride], y[start:stop:stride], linestyle="none", marker="o", color=colour)
        if name and stop - start > 2:
            _label_arc(axes, x[start:stop], y[start:stop], name, colour, offset=0.22 * extent)
    (ring,) = axes.plot(x[:1], y[:1], linestyle="none", marker="o", markersize=6.5, color=INK)
    ring.set(markerfacecolor="none", markeredgewidth=1.0)


def _label_arc(axes: Axes, x: Array, y: Array, name: str, colour: str, *, offset: float) -> None:
    """Write a name inside an arc, `offset` from its middle towards the middle of its chord."""
    middle = len(x) // 2
    inward_x, inward_y = (x[0] + x[-1]) / 2 - x[middle], (y[0] + y[-1]) / 2 - y[middle]
    share = offset / max(float(np.hypot(inward_x, inward_y)), 1e-9)
    at_x, at_y = x[middle] + share * inward_x, y[middle] + share * inward_y
    axes.text(at_x, at_y, name, color=colour, ha="center", va="center", fontweight="bold")


# ---------------------------------------------------------------------------------------------- figure 5


def _projection(run: _Run) -> str:
    result = run.result
    undefined = (np.nan,) * 6
    entries = np.array([undefined if p is None else p for p in result.traces.projection], dtype=np.float64)
    truth = None if result.truth is None else np.array(result.truth.projection).ravel()
    figure = Figure(figsize=(WIDTH_IN, 3.9))
    panels = figure.subplots(2, 3, sharex=True)
    figure.subplots_adjust(left=0.075, right=0.985, bottom=0.11, top=0.93, wspace=0.35, hspace=0.28)
    for index, axes in enumerate(panels.flat):
        row, column = divmod(index, 3)
        unit = "px" if column == 2 else "px/µm"
        axes.set_title(f"p{'₁₂'[row]}{'₁₂₃'[column]} ({unit})")
        known = None if truth is None else float(truth[index])
        if not _estimate(axes, run, entries[:, index], known, slice(0, len(run.frame))):
            run.off_scale.add("projection")
        _frame_axis(axes, run, slice(0, len(run.frame)), labelled=row == 1)
    return inline_svg(figure, key="projection", label="The six entries of P over the frames")


# ---------------------------------------------------------------------------------------------- figure 6


def _error(run: _Run) -> str:
    result = run.result
    prior, posterior = _array(result.prediction_error_px), _array(result.posterior_error_px)
    defined = np.concatenate([prior, posterior])
    defined = defined[np.isfinite(defined)]
    top = max(1.0, 2.0 * float(defined.max())) if len(defined) else 1.0
    figure, panels = _whole_and_zoomed(run)
    for axes, window in panels:
        for values, colour, width in ((posterior, ORANGE, 1.0), (prior, BLUE, 1.4)):
            _line(axes, run.frame[window], np.maximum(values[window], FLOOR_PX), colour, width)
        axes.set_yscale("log")
        axes.set_ylim(FLOOR_PX, top)
        decades = [10.0**power for power in range(-3, 6) if 10.0**power <= top]
        axes.set_yticks(decades, [f"{decade:g}" for decade in decades])
        axes.yaxis.set_minor_locator(NullLocator())
        axes.axhline(LIMIT_PX, color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
        _frame_axis(axes, run, window)
        at_right = float(run.frame[window][-1])
        axes.annotate("0.1 px", (at_right, LIMIT_PX), (0, 3), textcoords="offset points", ha="right", color=INK)
    whole, last = panels[0][0], panels[-1][0]
    whole.set_ylabel("prediction error (px)")
    whole.text(0.985, 0.95, "a priori", color=BLUE, ha="right", transform=whole.transAxes, fontweight="bold")
    whole.text(0.985, 0.87, "a posteriori", color=ORANGE, ha="right", transform=whole.transAxes, fontweight="bold")
    _mark_settled(last, run, top)
    return inline_svg(figure, key="error", label="Prediction error over the frames")


def _mark_settled(axes: Axes, run: _Run, top: float) -> None:
    settled = settled_index(run.result)
    if run.change is None or settled is None or settled >= len(run.frame):
        return
    frame = float(run.frame[settled])
    axes.axvline(frame, color=INK, linewidth=0.8)
    text = f"within 0.1 px from\niteration {settled - run.change.first_frame + 1} (frame {frame:g})"
    axes.annotate(text, (frame, top), (5, -2), textcoords="offset points", va="top", color=INK)


# ---------------------------------------------------------------------------------------------- figure 7


def _magnification(run: _Run) -> str:
    result, truth = run.result, run.result.truth
    if result.magnification is None:
        values, label = _array(result.traces.scale_px_per_um), "scale (px/µm)"
        known = None if truth is None else truth.scale_px_per_um
    else:
        values, label = _array(result.magnification_trace), "magnification"
        known = None if truth is None else truth.magnification
    figure, panels = _whole_and_zoomed(run)
    for axes, window in panels:
        close_up = axes is not panels[0][0]
        if not _estimate(axes, run, values, known, window, close_up=close_up) and not close_up:
            run.off_scale.add("magnification")
        _frame_axis(axes, run, window)
    panels[0][0].set_ylabel(label)
    if len(panels) > 1:
        panels[1][0].set_title("(b) around the zoom change, at the new value")
    return inline_svg(figure, key="magnification", label=f"Computed {label} over the frames")


# ---------------------------------------------------------------------------------------------- common parts


def _whole_and_zoomed(run: _Run) -> tuple[Figure, list[tuple[Axes, slice]]]:
    """One panel of the whole run and, if the zoom changed, one of the frames around the change."""
    figure = Figure(figsize=(WIDTH_IN, 2.9))
    whole = slice(0, len(run.frame))
    windows = [whole] if run.change is None else [whole, run.window()]
    panels = figure.subplots(1, len(windows), squeeze=False)
    figure.subplots_adjust(left=0.085, right=0.985, bottom=0.16, top=0.91, wspace=0.17)
    if len(windows) > 1:
        panels[0][0].set_title("(a) whole run")
        panels[0][1].set_title("(b) around the zoom change")
    return figure, list(zip(panels[0], windows, strict=True))


def _frame_axis(axes: Axes, run: _Run, window: slice, *, labelled: bool = True) -> None:
    """The axis that figures 5–7 share, with the frames shaded in which the zoom moved."""
    frames, moving = run.frame[window], run.moving[window]
    edges = np.diff(np.concatenate([[False], moving, [False]]).astype(int))
    for start, stop in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        axes.axvspan(frames[start] - 0.5, frames[stop - 1] + 0.5, color=SHADE, linewidth=0, zorder=0.3)
    axes.set_xlim(frames[0] - 0.5, frames[-1] + 0.5)
    _ticks(axes.xaxis, frames[0], frames[-1], MaxNLocator(5, integer=True, steps=[1, 2, 5, 10]))
    if labelled:
        axes.set_xlabel("frame")


def _ticks(axis: Axis, low: float, high: float, locator: MaxNLocator) -> None:
    """Round values within the limits only: ticks out of sight are made too, and ticks are most of the time."""
    axis.set_ticks([tick for tick in locator.tick_values(low, high) if low <= tick <= high])


def _estimate(
    axes: Axes, run: _Run, values: Array, truth: float | None, window: slice, *, close_up: bool = False
) -> bool:
    """A parameter over the frames of a window, and its truth where that is known.

    The scale fits what has settled, in a close-up after the zoom change only. Returns whether it fits all.
    """
    _line(axes, run.frame[window], values[window], BLUE, 1.3)
    after = run.after_change()
    if truth is not None and after.start < len(run.frame):
        axes.plot(run.frame[[after.start, -1]], [truth, truth], color=INK, linewidth=0.9, linestyle=(0, (4, 3)))
    trusted = run.trusted.copy()
    if close_up:
        trusted[: after.start] = False
    limits = _limits(
        values[window], trusted[window], [] if truth is None else [truth], least=5e-3 if close_up else 1e-3
    )
    if limits is None:
        axes.text(0.5, 0.5, "not determined", color=MUTED, ha="center", transform=axes.transAxes)
        return True
    axes.set_ylim(*limits)
    _ticks(axes.yaxis, *limits, MaxNLocator(4))
    shown = values[window][np.isfinite(values[window])]
    return bool(shown.min() >= limits[0] and shown.max() <= limits[1])


def _limits(values: Array, trusted: Mask, others: Sequence[float], *, least: float) -> tuple[float, float] | None:
    """Room for all trusted values, and for a transient up to their range beyond them; None without values.

    Their range counts as `least` of their size at the least.
    """
    finite = values[np.isfinite(values)]
    if not len(finite):
        return None
    core = values[trusted & np.isfinite(values)]
    core = np.append(core if len(core) else finite, others)
    low, high = float(core.min()), float(core.max())
    span = max(high - low, least * max(abs(low), abs(high)), 1e-9)
    bottom = max(min(float(finite.min()), low), low - span)
    top = min(max(float(finite.max()), high), high + span)
    margin = max(0.07 * (top - bottom), 0.1 * span)
    return bottom - margin, top + margin


def _line(axes: Axes, frame: Array, values: Array, colour: str, width: float) -> None:
    marker = "o" if len(frame) <= _FEW_FRAMES else ""
    axes.plot(*_envelope(frame, values), color=colour, linewidth=width, marker=marker)


def _envelope(frame: Array, values: Array) -> tuple[Array, Array]:
    """At most `_MOST_POINTS` points of a long trace: the lowest and highest value of each stretch."""
    if len(values) <= _MOST_POINTS:
        return frame, values
    length = -(-2 * len(values) // _MOST_POINTS)
    kept: list[int] = []
    for start in range(0, len(values), length):
        stretch = values[start : start + length]
        if np.all(np.isnan(stretch)):
            kept.append(start)
        else:
            kept += sorted({start + int(np.nanargmin(stretch)), start + int(np.nanargmax(stretch))})
    return frame[kept], values[kept]


def _array(trace: Trace) -> Array:
    return np.array([np.nan if value is None else value for value in trace], dtype=np.float64)
