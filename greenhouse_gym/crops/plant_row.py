"""A row of plants and where things stand in it."""

from __future__ import annotations

from dataclasses import dataclass

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


@dataclass(frozen=True, eq=False)
class PlantRow:
    """A row of tomato plants in the world frame (metres): analytic primitives, or organs as meshes.

    The frame: z up, y along the row, x into the plants, origin on the floor below the tripod's first station; the stem
    line is at x = 0.5 m.

    Attributes:
        tomatoes: Every fruit, with its truss and ripeness.
        stems: Main stems, peduncles, pedicels, strings and pipes as straight capsules.
        clutter: Leaves (thin boxes, petioles as capsules) and the gutter.
        length: Length of the row that is meant to be photographed, metres, from y = 0.
        week: Growth week; 0 is the first harvest.
        behind: The next row, or None.
        organs: The meshes of a row that is made of such; its tomatoes and stems are computed from them.
    """

    tomatoes: tuple[Tomato, ...]
    stems: tuple[Stem, ...]
    clutter: tuple[Shape, ...]
    length: float
    week: int
    behind: PlantRow | None = None
    organs: tuple[Organ, ...] = ()

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """All shapes in this order: tomatoes, stems, clutter; without the row behind."""
        return (*(tomato.shape for tomato in self.tomatoes), *self.stems, *self.clutter)
