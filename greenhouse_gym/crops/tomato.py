"""The tomato crop: two growth functions, the cultivars they know, and the defaults of the package."""

from __future__ import annotations

from typing import Any

from greenhouse_gym.crops.analytic_growth import grow_analytic_row
from greenhouse_gym.crops.crop import STEM_LINE, Crop, PlantRow
from greenhouse_gym.crops.cultivars import CULTIVARS, STYLES, Cultivar
from greenhouse_gym.crops.mesh_growth import grow_mesh_row
from greenhouse_gym.errors import UnknownNameError, require_choice

DEFAULT_STYLE = "cluster"


def _grow_own(seed: int, length: float, week: int, style: Any, stem_line: float) -> PlantRow:
    style = DEFAULT_STYLE if style is None else style
    if not isinstance(style, str) or style not in STYLES:
        raise UnknownNameError("fruit style", style, STYLES)
    return grow_analytic_row(seed, length, week, STYLES[style], stem_line)


def _grow_helios(seed: int, length: float, week: int, style: Any, stem_line: float) -> PlantRow:
    style = DEFAULT_STYLE if style is None else style
    cultivar = style if isinstance(style, Cultivar) else CULTIVARS[require_choice("cultivar", style, CULTIVARS)]
    return grow_mesh_row(seed, length, week, cultivar, stem_line)


TOMATO = Crop("tomato", {"own": _grow_own, "helios": _grow_helios})
"""Tomato. Default colors, shape settings and motion of the package are those of tomato."""

SOURCES: tuple[str, ...] = tuple(TOMATO.sources)
"""Sources of plants: the package's own analytic shapes, or organ meshes grown by Helios (extra ``plants``)."""


def grow_row(
    seed: int,
    length: float = 5.0,
    week: int = 0,
    style: str | Cultivar = DEFAULT_STYLE,
    stem_line: float = STEM_LINE,
    source: str = "own",
) -> PlantRow:
    """Grow a row of tomato plants with a second row behind it.

    Args:
        seed: Same seed, same plants; over the weeks the same plants continue to grow.
        length: Length of row to be photographed, metres; plants stand half a metre beyond both ends.
        week: Growth week, 0 = first harvest.
        style: One of `STYLES`; with ``source="helios"`` one of `CULTIVARS`, or a `Cultivar`.
        stem_line: x of the row, metres.
        source: One of `SOURCES`.

    Returns:
        The row in the world frame.

    Raises:
        InvalidValueError: ``length`` is not positive and finite, or ``week`` or ``seed`` is negative.
        UnknownNameError: No such style or source.
        MissingDependencyError: ``source="helios"`` without the extra ``plants``.
    """
    return TOMATO.grow(seed, length, week, style, stem_line, source)
