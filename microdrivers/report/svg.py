"""Matplotlib figures as SVG for a page: its fonts, its colours in light and dark, no identifiers that clash."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

INK = "#1c2128"
MUTED = "#5a6370"
GRID = "#e1e5ea"
SHADE = "#e9dfc9"
MOVING = "#8b929c"
BLUE = "#0072b2"
ORANGE = "#d55e00"
WIDTH_IN = 8.8

# Each colour becomes a variable of the page's style sheet, which knows light and dark.
_VARIABLES = {
    INK: "--ink", MUTED: "--muted", GRID: "--grid", SHADE: "--shade", MOVING: "--moving", BLUE: "--blue",
    ORANGE: "--orange",
}  # fmt: skip

# Any: the keys' type is a literal of Matplotlib's own version.
_STYLE: Any = {
    "svg.fonttype": "none",
    "font.family": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.titlesize": 8.5,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.titley": 1.0,  # a fixed height: finding one costs a third of the drawing
    "axes.labelsize": 8.5,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": MOVING,
    "axes.linewidth": 0.7,
    "axes.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.formatter.useoffset": False,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": MOVING,
    "ytick.color": MOVING,
    "xtick.labelcolor": MUTED,
    "ytick.labelcolor": MUTED,
    "xtick.bottom": False,
    "ytick.left": False,
    "lines.linewidth": 1.2,
    "lines.markersize": 2.6,
    "lines.markeredgewidth": 0.0,
}


@contextmanager
def page_style() -> Iterator[None]:
    """Matplotlib's settings for figures of a page, restored afterwards; they are the process's, not a thread's."""
    with matplotlib.rc_context(_STYLE):
        yield


def inline_svg(figure: Figure, *, key: str, label: str) -> str:
    """The figure as an `<svg>` element to stand in an HTML page; call within `page_style`.

    Args:
        figure: what to draw.
        key: distinguishes the figure's identifiers from those of other figures on the page.
        label: what a screen reader says instead of the figure.

    Returns:
        The element, as wide as its surroundings. Equal figures give equal text.
    """
    FigureCanvasSVG(figure)
    buffer = io.BytesIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with matplotlib.rc_context({"svg.hashsalt": key}):
        figure.savefig(buffer, format="svg", transparent=True, metadata=nothing)
    svg = buffer.getvalue().decode("utf-8")
    svg = svg[svg.index("<svg") :]
    opening, _, rest = svg.partition(">")
    view_box = re.search(r'viewBox="[^"]*"', opening)
    box = view_box.group(0) if view_box else ""
    # Matplotlib's own style element would apply to the whole page; its groups' names occur in every figure.
    rest = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>", "", rest, count=1, flags=re.DOTALL)
    rest = re.sub(r'<g id="[^"]*"', "<g", rest)
    rest = re.sub(r"font-family: [^;\"]*;? ?|(?<=font: )", "", rest)
    rest = re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path.group(0)), rest)
    for colour, variable in _VARIABLES.items():
        rest = rest.replace(colour, f"var({variable})")
    return f'<svg {box} role="img" aria-label="{html.escape(label)}">{rest}'
