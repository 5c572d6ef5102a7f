"""A row of plants, the heights and distances of its trellis, and its colors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from greenhouse_gym.crops.organs import Organ
from greenhouse_gym.crops.parts import Stem, Tomato
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
