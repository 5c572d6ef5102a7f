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
    """What an axis shows, and from where to where.

    Attributes:
        label: Written beside it.
        low: Its low end.
        high: Its high end.
        flipped: Puts its low end to the right or to the top.
        log: Whether equal ways on it are equal factors.
        names: Written in place of the numbers 0, 1, ...
    """

    label: str
    low: float
    high: float
    flipped: bool = False
    log: bool = False
    names: Sequence[str] = ()

    def ticks(self) -> Array:
        """About five round values on the axis, of one digit if it is logarithmic, or those that have names."""
        if self.names:
            return np.arange(len(self.names), dtype=float)
        if self.log:
            low, high = np.log10((self.low, self.high))
            digits = (1.0,) if high - low > 3 else (1.0, 2.0, 5.0)
            ticks = np.outer(10.0 ** np.arange(np.floor(low), np.ceil(high)), digits).ravel()
            return ticks[(ticks >= self.low) & (ticks <= self.high)]
        raw = (self.high - self.low) / 5
        power = 10.0 ** np.floor(np.log10(raw))
        step = power * next(factor for factor in (1, 2, 5, 10) if factor * power >= raw)
        return step * np.arange(np.ceil(self.low / step - 1e-9), np.floor(self.high / step + 1e-9) + 1)

    def place(self, values: Array, start: float, end: float) -> Array:
        """Where values lie, in pixels, if the axis goes from ``start`` to ``end``."""
        low, high = self.low, self.high
        if self.log:
            values, low, high = np.log10(values), np.log10(low), np.log10(high)
        share = (values - low) / (high - low)
        return np.round(start + (1.0 - share if self.flipped else share) * (end - start), 1)

    def texts(self) -> list[str]:
        """What is written at the ticks."""
        return list(self.names) or [_number(value) for value in self.ticks()]


def axis_around(label: str, values: Array, least: float, flipped: bool = False) -> Axis:
    """An axis with room for some values, at least ``least`` long."""
    low, high = float(np.min(values)), float(np.max(values))
    margin = max(0.06 * (high - low), (least - (high - low)) / 2)
    return Axis(label, low - margin, high + margin, flipped)


class Series(NamedTuple):
    """Points of a plot.

    Attributes:
        points: (n, 2) values along the horizontal and the vertical axis.
        style: Blue dots, hollow red dots, a dashed red line through the points, or of the series' own color dots or a
            line.
        names: Names of the points, or of the line; shown when the pointer rests on one.
        labels: Written above the points.
        color: The series' own.
        spans: (n, 2) from where to where the vertical value of each point may lie.
    """

    points: Array
    style: Literal["good", "bad", "limit", "dots", "line"]
    names: Sequence[str] = ()
    labels: Sequence[str] = ()
    color: str = ""
    spans: Array | None = None

    @property
    def look(self) -> str:
        """How it is drawn, as attributes."""
        own = {"dots": f'fill="{self.color}"', "line": f'fill="none" stroke="{self.color}" stroke-width="2"'}
        return (_STYLES | own)[self.style]


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
    for text, at in zip(x.texts(), x.place(x.ticks(), _LEFT, right), strict=True):
        parts.append(f'<line {_GRID} x1="{at}" y1="{_TOP}" x2="{at}" y2="{bottom}"/>')
        parts.append(f'<text x="{at}" y="{bottom + 15}" text-anchor="middle">{escape(text)}</text>')
    for text, at in zip(y.texts(), y.place(y.ticks(), bottom, _TOP), strict=True):
        parts.append(f'<line {_GRID} x1="{_LEFT}" y1="{at}" x2="{right}" y2="{at}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{at + 4}" text-anchor="end">{escape(text)}</text>')
    for one in series:
        pixels = np.column_stack([x.place(one.points[:, 0], _LEFT, right), y.place(one.points[:, 1], bottom, _TOP)])
        if one.spans is not None:
            for u, (low, high) in zip(pixels[:, 0], y.place(one.spans, bottom, _TOP), strict=True):
                ends = f'x1="{u}" y1="{low}" x2="{u}" y2="{high}"'
                parts.append(f'<line stroke="{one.color}" stroke-width="1.5" {ends}/>')
        parts += _line(pixels, one) if one.style in ("limit", "line") else _dots(pixels, one)
    parts += [
        f'<text x="{(_LEFT + right) / 2}" y="{height - 6}" text-anchor="middle">{escape(x.label)}</text>',
        f'<text x="12" y="{middle}" text-anchor="middle" transform="rotate(-90 12 {middle})">{escape(y.label)}</text>',
        "</svg>",
    ]
    return "\n".join(parts)


def _line(pixels: Array, series: Series) -> list[str]:
    name = "".join(f"<title>{escape(name)}</title>" for name in series.names)
    points = " ".join(f"{u},{v}" for u, v in pixels)
    return [f'<polyline {series.look} points="{points}">{name}</polyline>']


def _dots(pixels: Array, series: Series) -> list[str]:
    names = [f"<title>{escape(name)}</title>" for name in series.names] or [""] * len(pixels)
    dots = [
        f'<circle {series.look} cx="{u}" cy="{v}" r="3.5">{name}</circle>'
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
