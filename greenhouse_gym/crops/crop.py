"""Crop: growth, colors, motion and shape settings in one object, which is all that another crop needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from greenhouse_gym.crops.plant_row import STEM_LINE, Palette, PlantRow
from greenhouse_gym.errors import InvalidValueError, check_whole, is_number, require_choice, require_seed


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
