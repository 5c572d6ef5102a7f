"""What stands around an arm, and where the arm stands: the part of a scene that has a shape."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    model_validator,
)

from greenhouse_gym.common.files import checked_name
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box, Capsule, Shape, Sphere, Vector
from greenhouse_gym.scene.packed import pack, unpack

SceneName = Annotated[str, AfterValidator(lambda name: checked_name("a scene", name))]

MOST_TOMATOES, MOST_SHAPES = 2000, 50_000
"""The most tomatoes, and the most stems and the most pieces of clutter, that a scene may hold."""

LARGEST = 100.0
"""The largest coordinate or size in a scene, metres: single precision still resolves a hundredth of a millimetre."""


def is_none(value: object) -> bool:
    """Whether a value is None: files leave such fields out, so that older files stay as they are."""
    return value is None


def _not_newer(version: Any) -> Any:
    if isinstance(version, int) and version > 1:
        raise InvalidValueError(
            f"written by a newer version of greenhouse-gym, in schema {version}; this one reads schema 1: update it"
        )
    return version


SchemaVersion = Annotated[Literal[1], BeforeValidator(_not_newer)]
"""The version of the schema that scene files and manifests carry."""


class Part(BaseModel):
    """What parts of a scene file have in common: they do not change, and hold what is named and finite only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Stand(Part):
    """Where the arm stands in the scene frame.

    Attributes:
        position: (3,) point on the floor below the base axis, metres.
        yaw: Heading about z, radians; 0 faces the plants (+x).
        shoulder_height: Height of the shoulder joint above that point, metres.
    """

    position: Vector = Field(default_factory=lambda: [0.0, 0.0, 0.0], validate_default=True)
    yaw: float = Field(default=0.0, ge=-100, le=100)
    shoulder_height: float = Field(default=1.1, gt=0, le=10)

    @model_validator(mode="after")
    def _not_far(self) -> Stand:
        if np.abs(self.position).max() > LARGEST:
            raise InvalidValueError(f"position {self.position.tolist()} is farther than {LARGEST:g} m from the origin")
        return self


class Shapes(Part):
    """Tomatoes, stems and clutter in the scene frame: what stands around the arm."""

    tomatoes: tuple[Tomato, ...] = Field(default=(), max_length=MOST_TOMATOES)
    stems: tuple[Stem, ...] = Field(default=(), max_length=MOST_SHAPES)
    clutter: tuple[Sphere | Capsule | Box, ...] = Field(default=(), max_length=MOST_SHAPES)

    @model_validator(mode="after")
    def _not_large(self) -> Self:
        if _largest(self.obstacles) > LARGEST:
            for kind in ("tomatoes", "stems", "clutter"):
                for i, shape in enumerate(getattr(self, kind)):
                    if _largest([shape]) > LARGEST:
                        raise InvalidValueError(f"{kind}.{i} is larger, or farther away, than {LARGEST:g} m: {shape}")
        return self

    @property
    def obstacles(self) -> tuple[Shape, ...]:
        """All shapes in one order: tomatoes, stems, clutter."""
        return (*self.tomatoes, *self.stems, *self.clutter)

    def compact(self) -> Shapes:
        """The shapes as a scene file keeps those of its truth: to 0.1 mm, the clutter sorted by kind."""
        return _unpacked(_packed(self))


def _largest(shapes: Sequence[Shape]) -> float:
    """The largest number in shapes: a coordinate or a size, metres, if it is large."""
    numbers = [v for shape in shapes for v in vars(shape).values() if isinstance(v, np.ndarray | float)]
    return float(np.abs(np.concatenate([np.ravel(number) for number in numbers])).max()) if numbers else 0.0


def _packed(shapes: Shapes) -> dict[str, Any]:
    return pack(shapes.tomatoes, shapes.stems, shapes.clutter)


def _unpacked(value: Any) -> Any:
    if isinstance(value, dict) and "rows" in value:
        parts = unpack(value)
        return Shapes(tomatoes=parts.tomatoes, stems=parts.stems, clutter=parts.clutter)
    return value


PackedShapes = Annotated[
    Shapes,
    BeforeValidator(_unpacked),
    PlainSerializer(_packed, return_type=dict[str, Any], when_used="json"),
]
"""Shapes that a file keeps in tables (see `greenhouse_gym.scene.packed`), to 0.1 mm."""


class Surroundings(Shapes):
    """Shapes and where an arm stands among them: what a collision model is made of."""

    name: SceneName
    stand: Stand = Field(default_factory=Stand)
