"""Plots drawn by matplotlib: SVG inside pages, the same bytes for the same data, and the demo's training curve."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from html import escape
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.extras import needs

with needs("viz"):
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, PercentFormatter

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

GOOD, BAD = "#1f5fa8", "#b3261e"

_GRAY, _GRID = "#444444", "#dddddd"
_STYLE = {
    "font.sans-serif": ["DejaVu Sans"], "font.size": 11,
    "text.color": _GRAY, "axes.labelcolor": _GRAY, "xtick.color": _GRAY, "ytick.color": _GRAY,
    "axes.grid": True, "grid.color": _GRID, "grid.linewidth": 1, "axes.axisbelow": True,
    "axes.spines.left": False, "axes.spines.right": False, "axes.spines.top": False, "axes.spines.bottom": False,
    "xtick.major.size": 0, "ytick.major.size": 0, "xtick.minor.size": 0, "xtick.major.pad": 7,
    "lines.linewidth": 2, "lines.markersize": 7, "figure.constrained_layout.use": True,
    "svg.fonttype": "none", "svg.hashsalt": "greenhouse-gym",
}  # fmt: skip
_TIP = "tip:"


def svg_plot(title: str, draw: Callable[[Axes], None], width: int = 560, height: int = 220) -> str:
    """Return a plot as an ``<svg>`` element.

    Args:
        title: Read aloud in place of the plot.
        draw: Draws into the axes.
        width: Pixels.
        height: Pixels.
    """
    written = StringIO()
    with mpl.rc_context(_STYLE):
        figure = Figure((width / 72, height / 72))
        draw(figure.add_subplot())
        unnamed = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(written, format="svg", transparent=True, metadata=unnamed)
    _, _, svg = written.getvalue().partition("<svg")
    # groups need no names, which several plots of a page would share; only texts to show on hovering are kept
    svg = re.sub(rf'<g id="({_TIP})?([^"]*)">', lambda g: f"<g><title>{g[2]}</title>" if g[1] else "<g>", svg)
    return f'<svg role="img" aria-label="{escape(title)}"{svg}'


def hover(artist: Artist, text: str) -> None:
    """Show a text when the pointer rests on an artist of a plot."""
    artist.set_gid(_TIP + text)


def fractions(axes: Axes, label: str) -> None:
    """Make the vertical axis one of fractions, 0 to 100 %."""
    axes.set_ylim(0, 1)
    axes.set_ylabel(label)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))


def whole_numbers(axes: Axes) -> None:
    """Put the horizontal axis's ticks at whole numbers."""
    axes.xaxis.set_major_locator(MaxNLocator(10, integer=True, steps=[1, 2, 5, 10]))


def logarithmic(axes: Axes, low: float, high: float) -> None:
    """Make the horizontal axis logarithmic, with ticks at 1, 2 and 5 of each decade, or only at 1 if it is long."""
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    digits = (1.0,) if high > 1e3 * low else (1.0, 2.0, 5.0)
    axes.xaxis.set_major_locator(LogLocator(subs=digits, numticks=20))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.minorticks_off()


def limits_around(values: npt.ArrayLike, min_range: float) -> tuple[float, float]:
    """Return the limits of an axis with a margin around some values, at least ``min_range`` apart."""
    low, high = float(np.min(values)), float(np.max(values))
    margin = max(0.06 * (high - low), (min_range - (high - low)) / 2)
    return low - margin, high + margin


def training_curve(steps: Sequence[float], success: Sequence[float], random_success: float, path: Path) -> Path:
    """Draw success over training steps to a PNG file, with the success of a random agent as a line."""
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(np.asarray(steps) / 1e6, 100 * np.asarray(success), color="#2c7a3f", linewidth=2, label="PPO")
    axes.axhline(100 * random_success, color="#b03a2e", linestyle="--", label="random agent")
    axes.set(xlabel="environment steps (millions)", ylabel="episodes that reach the tomato (%)", ylim=(0, 100))
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    return path
