"""Crop: growth, colors, motion and shape settings in one object, which is all that another crop needs; and its rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from greenhouse_gym.crops.organs import Organ
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.errors import InvalidValueError, check_whole, is_number, require_choice, require_seed
from greenhouse_gym.geometry import Shape

STEM_LINE = 0.5
"""Distance of the stem line from the tripod's line, metres: x of the row in the world frame."""

ROW_PITCH = 1.6
PLANT_SPACING = (0.42, 0.58)
TRUSS_SPACING = (0.20, 0.30)
GUTTER_HEIGHT = 0.5
GUTTER_COLOR = (0.90, 0.90, 0.88)
WIRE_HEIGHT = 2.4
LOWEST_TRUSS, HIGHEST_TRUSS = 0.6, 2.2

Color = tuple[float, float, float]

_STEM_COLORS: dict[str, Color] = {
    "main": (0.36, 0.50, 0.22),
    "peduncle": (0.42, 0.58, 0.26),
    "pedicel": (0.45, 0.60, 0.28),
    "string": (0.85, 0.84, 0.78),
    "pipe": (0.80, 0.80, 0.80),
}


@dataclass(frozen=True)
class Palette:
    """Colors of a row of analytic shapes in photographs, RGB in [0, 1]; by default green plants whose fruit turns red.

    Attributes:
        fruit: Skin at ripeness 0, 1/3, 2/3 and 1.
        stems: Color of each kind of stem.
        leaf: Color of leaves.
    """

    fruit: tuple[Color, Color, Color, Color] = (
        (0.46, 0.58, 0.24),
        (0.72, 0.62, 0.20),
        (0.86, 0.42, 0.12),
        (0.76, 0.10, 0.07),
    )
    stems: Mapping[str, Color] = field(default_factory=_STEM_COLORS.copy)
    leaf: Color = (0.20, 0.42, 0.16)


@dataclass(frozen=True, eq=False)
class PlantRow:
    """A row of plants in the world frame (metres), as analytic shapes or as meshes of organs.

    The frame: z up, y along the row, x into the plants, origin on the floor below the tripod's first station. The stem
    line is at x = 0.5 m.

    Attributes:
        tomatoes: All fruits with their trusses and ripeness.
        stems: Main stems, peduncles, pedicels, strings and pipes as straight capsules.
        clutter: Leaves (thin boxes, petioles as capsules) and the gutter.
        length: Length of the row to be photographed from y = 0, metres.
        week: Growth week; 0 is the first harvest.
        behind: The next row, or None.
        organs: Meshes of the organs, from which tomatoes and stems were computed; empty for analytic rows.
        palette: Colors of an analytic row and the one behind it.
    """

    tomatoes: tuple[Tomato, ...]
    stems: tuple[Stem, ...]
    clutter: tuple[Shape, ...]
    length: float
    week: int
    behind: PlantRow | None = None
    organs: tuple[Organ, ...] = ()
    palette: Palette = field(default_factory=Palette)

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """All shapes in this order: tomatoes, stems, clutter; without the row behind."""
        return (*(tomato.shape for tomato in self.tomatoes), *self.stems, *self.clutter)


class Growth(Protocol):
    """Function that grows a row."""

    def __call__(self, seed: int, length: float, week: int, style: Any, stem_line: float, /) -> PlantRow:
        """Grow a row, possibly with a second row behind it.

        Args:
            seed: Same seed, same plants; over the weeks the same plants continue to grow.
            length: Length of row to be photographed, metres.
            week: Growth week, 0 = first harvest.
            style: Variety of the crop, in any form that the function understands, or None for its default.
            stem_line: x of the row, metres.
        """
        ...


@dataclass(frozen=True)
class PlantMotion:
    """Standard deviations of the motion of plants (`greenhouse_gym.scene.plant_motion`).

    Attributes:
        truss_turn: Turn of a truss about the vertical through its root, radians.
        truss_swing: Swing of a truss about horizontal axes through its root, radians.
        stem_shift: Shift of stems and all that hangs on them, metres along each horizontal axis.
        leaf_shift: Additional shift of leaves, metres along each axis.
    """

    truss_turn: float = 0.10
    truss_swing: float = 0.05
    stem_shift: float = 0.005
    leaf_shift: float = 0.010

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (is_number(value) and 0 <= value <= 1):
                raise InvalidValueError(f"plant motion {name} must be a number from 0 to 1, got {value!r}")


@dataclass(frozen=True)
class Crop:
    """Growth, colors, motion and shape settings of a kind of plant.

    Attributes:
        name: Its name.
        sources: Growth functions by name; the first one is the default.
        palette: Colors of analytic rows.
        shape_settings: Values of `greenhouse_gym.shapes.ShapeSettings` that differ from their defaults.
        motion: Motion of its plants between scan and reach.
    """

    name: str
    sources: Mapping[str, Growth]
    palette: Palette = field(default_factory=Palette)
    shape_settings: Mapping[str, Any] = field(default_factory=dict)
    motion: PlantMotion = field(default_factory=PlantMotion)

    def grow(
        self,
        seed: int,
        length: float = 5.0,
        week: int = 0,
        style: Any = None,
        stem_line: float = STEM_LINE,
        source: str | None = None,
    ) -> PlantRow:
        """Grow a row; arguments as for `Growth`.

        Args:
            seed: Seed of the plants.
            length: Length of row to be photographed, metres.
            week: Growth week.
            style: Variety of the crop, or None for its default.
            stem_line: x of the row, metres.
            source: One of `sources`, or None for the first.

        Returns:
            The row in the world frame.

        Raises:
            InvalidValueError: ``length`` is not positive and finite, or ``week`` or ``seed`` is negative.
            UnknownNameError: No such style or source.
        """
        if not (np.isfinite(length) and length > 0):
            raise InvalidValueError(f"length must be a positive number of metres, got {length!r}")
        week, seed = check_whole("week", week, 0), require_seed(seed)
        chosen = (
            next(iter(self.sources)) if source is None else require_choice("source of plants", source, self.sources)
        )
        return replace(self.sources[chosen](seed, length, week, style, stem_line), palette=self.palette)
