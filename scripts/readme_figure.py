"""Draws the README's figure: readme_figure.py runs/demo/result.json docs/images/calibration.png."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from microdrivers.results.optics import OpticsResult, read_result

BEFORE, AFTER, MOVING = "#0b6fa8", "#c8560a", "#d9c9a5"


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
    for axes in (image, error, magnification):
        axes.spines[["top", "right"]].set_visible(False)
        axes.title.set_fontsize(10)
        axes.grid(alpha=0.25, lw=0.5)
    return figure


if __name__ == "__main__":
    draw(read_result(Path(sys.argv[1]))).savefig(sys.argv[2])
