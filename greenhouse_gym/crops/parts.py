"""Tomatoes and stems, as ground truth, shape extraction and scenes share them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Array, Box, Capsule, Ellipsoid, Shape, Sphere, transformed

StemKind = Literal["main", "peduncle", "pedicel", "string", "pipe"]
STEM_KINDS: tuple[str, ...] = get_args(StemKind)

MAX_LEAF = 0.15
"""Largest half extent of a box that is a piece of a leaf, metres. Longer boxes among the clutter are gutters."""


@dataclass(frozen=True, eq=False)
class Tomato:
    """A fruit: its shape, its truss and its ripeness.

    Attributes:
        shape: A sphere or an ellipsoid.
        truss: Number of its truss, unique within a row or scene.
        ripeness: 0 (green) to 1 (red), or None if unknown.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    shape: Sphere | Ellipsoid
    truss: int
    ripeness: float | None = None

    def __post_init__(self) -> None:
        if self.ripeness is not None and not 0.0 <= self.ripeness <= 1.0:
            raise InvalidValueError(f"ripeness must be between 0 and 1, got {self.ripeness!r}")

    @property
    def center(self) -> Array:
        """(3,) center, metres."""
        return self.shape.center

    @property
    def radius(self) -> float:
        """Radius of the sphere of the same volume, metres."""
        return self.shape.radius

    def transformed(self, target_from_source: Array) -> Tomato:
        """Express the tomato in another frame, given by a pose (4, 4)."""
        return replace(self, shape=transformed(self.shape, target_from_source))


@dataclass(frozen=True, eq=False)
class Stem(Capsule):
    """A straight piece of stem: a capsule with its kind, one of `STEM_KINDS`."""

    kind: StemKind

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice("stem kind", self.kind, STEM_KINDS)


class SpaceBox(Box):
    """Box over cells of space that count as solid, such as unknown ones; not a part of a plant."""


def is_leaf(shape: Shape) -> bool:
    """Return whether a piece of clutter belongs to a leaf and gives way when an arm brushes it.

    Leaves, petioles, calyces and flowers do: in the ground truth thin boxes and capsules, in a reconstruction boxes.
    Boxes with a half extent above `MAX_LEAF`, which are gutters, and a `SpaceBox` do not.
    """
    return not isinstance(shape, SpaceBox) and not (isinstance(shape, Box) and shape.half_extents.max() > MAX_LEAF)
