"""Small plots as inline SVG, for pages that open without a network and without scripts."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Literal, NamedTuple

import numpy as np

from greenhouse_gym.geometry import Array

_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 16, 12, 40  # px around the plot's area
_GRID = 'stroke="#ddd"'
_STYLES = {
    "good": 'fill="#1f5fa8"',
    "bad": 'fill="#fff" stroke="#b3261e" stroke-width="1.5"',
    "limit": 'fill="none" stroke="#b3261e" stroke-dasharray="5 4"',
}


class Axis(NamedTuple):
    """What an axis shows, and from where to where; ``flipped`` puts its low end to the right or to the top."""

    label: str
    low: float
    high: float
    flipped: bool = False

    def ticks(self) -> Array:
        """About five round values on the axis."""
        raw = (self.high - self.low) / 5
        power = 10.0 ** np.floor(np.log10(raw))
        step = power * next(factor for factor in (1, 2, 5, 10) if factor * power >= raw)
        return step * np.arange(np.ceil(self.low / step - 1e-9), np.floor(self.high / step + 1e-9) + 1)

    def place(self, values: Array, start: float, end: float) -> Array:
        """Where values lie, in pixels, if the axis goes from ``start`` to ``end``."""
        share = (values - self.low) / (self.high - self.low)
        return np.round(start + (1.0 - share if self.flipped else share) * (end - start), 1)


def axis_around(label: str, values: Array, least: float, flipped: bool = False) -> Axis:
    """An axis with room for some values, at least ``least`` long."""
    low, high = float(np.min(values)), float(np.max(values))
    margin = max(0.06 * (high - low), (least - (high - low)) / 2)
    return Axis(label, low - margin, high + margin, flipped)


class Series(NamedTuple):
    """Points of a plot.

    Attributes:
        points: (n, 2) values along the horizontal and the vertical axis.
        style: Blue dots, hollow red dots, or a dashed red line through the points.
        names: Names of the points; shown when the pointer rests on one.
        labels: Written above the points.
    """

    points: Array
    style: Literal["good", "bad", "limit"]
    names: Sequence[str] = ()
    labels: Sequence[str] = ()


def plot(title: str, x: Axis, y: Axis, series: Sequence[Series], width: int = 560, height: int = 220) -> str:
    """A plot as an ``<svg>`` element.

    Args:
        title: Read aloud in place of the plot.
        x: The horizontal axis.
        y: The vertical axis.
        series: What to draw, in this order.
        width: Pixels.
        height: Pixels.
    """
    right, bottom = width - _RIGHT, height - _BOTTOM
    middle = (_TOP + bottom) / 2
    parts = [
        f'<svg viewBox="0 0 {width} {height}" font-size="11" fill="#444" role="img" aria-label="{escape(title)}">',
    ]
    for value, at in zip(x.ticks(), x.place(x.ticks(), _LEFT, right), strict=True):
        parts.append(f'<line {_GRID} x1="{at}" y1="{_TOP}" x2="{at}" y2="{bottom}"/>')
        parts.append(f'<text x="{at}" y="{bottom + 15}" text-anchor="middle">{_number(value)}</text>')
    for value, at in zip(y.ticks(), y.place(y.ticks(), bottom, _TOP), strict=True):
        parts.append(f'<line {_GRID} x1="{_LEFT}" y1="{at}" x2="{right}" y2="{at}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{at + 4}" text-anchor="end">{_number(value)}</text>')
    for one in series:
        pixels = np.column_stack([x.place(one.points[:, 0], _LEFT, right), y.place(one.points[:, 1], bottom, _TOP)])
        parts += _line(pixels) if one.style == "limit" else _dots(pixels, one)
    parts += [
        f'<text x="{(_LEFT + right) / 2}" y="{height - 6}" text-anchor="middle">{escape(x.label)}</text>',
        f'<text x="12" y="{middle}" text-anchor="middle" transform="rotate(-90 12 {middle})">{escape(y.label)}</text>',
        "</svg>",
    ]
    return "\n".join(parts)


def _line(pixels: Array) -> list[str]:
    return [f'<polyline {_STYLES["limit"]} points="{" ".join(f"{u},{v}" for u, v in pixels)}"/>']


def _dots(pixels: Array, series: Series) -> list[str]:
    names = [f"<title>{escape(name)}</title>" for name in series.names] or [""] * len(pixels)
    dots = [
        f'<circle {_STYLES[series.style]} cx="{u}" cy="{v}" r="3.5">{name}</circle>'
        for (u, v), name in zip(pixels, names, strict=True)
    ]
    labels = [
        f'<text x="{u}" y="{v - 7}" text-anchor="middle">{escape(label)}</text>'
        for (u, v), label in zip(pixels, series.labels, strict=bool(series.labels))
    ]
    return dots + labels


def _number(value: float) -> str:
    """A tick's value without the dust of floating point."""
    return f"{round(value, 9) + 0.0:g}".replace("-", "−")
