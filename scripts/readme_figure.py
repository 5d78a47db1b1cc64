"""Draws the README's figures from results.

readme_figure.py runs/demo/result.json docs/images/calibration.png
readme_figure.py runs/force/result.json docs/images/force.png
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from microdrivers.results.force import ForceResult, read_force_result
from microdrivers.results.optics import OpticsResult, read_result

BEFORE, AFTER, MOVING = "#0b6fa8", "#c8560a", "#d9c9a5"
MEASURED = "#8b929c"


def draw(result: OpticsResult) -> Figure:
    """Trajectory in the image, prediction error and magnification over the frames."""
    figure = Figure(figsize=(11, 3.4), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    image, error, magnification = figure.subplots(1, 3, width_ratios=[1.0, 1.4, 1.4])
    traces, change = result.traces, result.zoom_change
    assert change is not None
    colours = [MOVING if m else BEFORE if f < change.first_frame else AFTER
               for f, m in zip(traces.frame, traces.zoom_moving, strict=True)]  # fmt: skip
    image.scatter(traces.u_px, traces.v_px, s=7, c=colours)
    image.set(aspect="equal", xlabel="u (px)", ylabel="v (px, down)", title="tracked corner, zoom 0.9 → 1.2")
    image.invert_yaxis()
    prior = np.array([np.nan if e is None else e for e in result.prediction_error_px])
    error.semilogy(traces.frame, prior, color=BEFORE, lw=1.3)
    error.axhline(0.1, color="black", lw=0.8, ls="--")
    error.set(xlabel="frame (30 Hz)", ylabel="px", title="a-priori prediction error", ylim=(1e-3, 50))
    settled = change.iterations_to_0p1_px
    if settled is not None:
        error.annotate(f"within 0.1 px after\n{settled} frames", (change.first_frame + settled, 0.1), xytext=(62, 1.2),
                       arrowprops={"arrowstyle": "-", "lw": 0.7}, fontsize=9)  # fmt: skip
    values = np.array([np.nan if m is None else m for m in result.magnification_trace])
    magnification.plot(traces.frame, values, color=BEFORE, lw=1.3)
    if result.truth is not None and result.truth.magnification is not None:
        later = [change.last_moving_frame + 1, traces.frame[-1]]
        magnification.plot(later, [result.truth.magnification] * 2, "k--", lw=0.8)
    magnification.set(xlabel="frame (30 Hz)", title="magnification (dashed: truth)", ylim=(1.25, 1.95))
    for axes in (error, magnification):
        axes.axvspan(change.first_frame - 0.5, change.last_moving_frame + 0.5, color=MOVING, alpha=0.7, lw=0)
    _plain(image, error, magnification)
    return figure


def draw_force(result: ForceResult) -> Figure:
    """The specimen's loop, its force rebuilt with and without slip, and the camera's force in a fresh indentation."""
    figure = Figure(figsize=(11, 3.4), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    loop, rebuilt, fresh = figure.subplots(1, 3, width_ratios=[1.0, 1.4, 1.4])
    traces = result.traces
    time, depth, force = (np.array(v, dtype=float) for v in (traces.time_s, traces.deformation_um, traces.force_uN))
    for name, colour in (("approach", MOVING), ("loading", BEFORE), ("unloading", AFTER), ("lost", MOVING)):
        there = np.array(traces.branch) == name
        loop.plot(np.where(there, depth, np.nan), np.where(there, force, np.nan), color=colour, lw=1.3)
    loop.set(
        xlabel="deformation, from the camera (µm)", ylabel="force (µN)", title="pressed (blue) and let go (orange)"
    )
    rebuilt.plot(time, force, color=MEASURED, lw=4, alpha=0.5, label="sensor")
    for name, colour in (("loading_only", AFTER), ("slip_corrected", BEFORE)):
        error = f"{name}, {result.protocols[name].error_percent:.2g} % off"  # type: ignore[index]
        rebuilt.plot(time, np.array(traces.fitted_uN[name], dtype=float), color=colour, lw=1.2, label=error)
    rebuilt.set(xlabel="time (s)", title="force rebuilt from deformation and speed")
    fresh.plot(traces.check_time_s, traces.check_force_uN, color=MEASURED, lw=4, alpha=0.5, label="sensor")
    seen = f"camera alone, {result.vision_force_error_percent or np.nan:.2g} % off"
    fresh.plot(traces.check_time_s, np.array(traces.check_vision_uN, dtype=float), color=BEFORE, lw=1.2, label=seen)
    fresh.set(xlabel="time (s)", title="pressed again, the sensor ignored")
    top = 1.5 * float(np.nanmax(force))
    for axes in (rebuilt, fresh):
        axes.set_ylim(top=top)
        axes.legend(loc="upper left", frameon=False, fontsize=8.5)
    _plain(loop, rebuilt, fresh)
    return figure


def _plain(*panels: Axes) -> None:
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.title.set_fontsize(10)
        axes.grid(alpha=0.25, lw=0.5)


if __name__ == "__main__":
    file = Path(sys.argv[1])
    is_force = json.loads(file.read_text(encoding="utf-8"))["kind"] == "force-characterisation"
    drawn = draw_force(read_force_result(file)) if is_force else draw(read_result(file))
    drawn.savefig(sys.argv[2])
