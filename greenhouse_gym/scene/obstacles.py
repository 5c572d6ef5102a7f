"""Obstacles around an arm and its placement: the part of a scene from which a collision model is made."""

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
from greenhouse_gym.crops.shape_tables import pack, unpack
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box, Capsule, Shape, Sphere, Vector

SceneName = Annotated[str, AfterValidator(lambda name: checked_name("a scene", name))]

MAX_TOMATOES, MAX_SHAPES = 2000, 50_000
"""Maximum number of tomatoes, and of stems and pieces of clutter each, in a scene."""

MAX_SIZE = 100.0
"""Maximum coordinate or size in a scene, metres: single precision still resolves a hundredth of a millimetre."""


def is_none(value: object) -> bool:
    """Return whether a value is None; scene files omit such fields."""
    return value is None


def _check_version(version: Any) -> Any:
    if isinstance(version, int) and version > 1:
        raise InvalidValueError(
            f"written by a newer version of greenhouse-gym, in schema {version}; this one reads schema 1: update it"
        )
    return version


SchemaVersion = Annotated[Literal[1], BeforeValidator(_check_version)]
"""Schema version of scene files and manifests."""


class Part(BaseModel):
    """Base of all parts of a scene file: immutable, finite, without unknown fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ArmPlacement(Part):
    """Position of the arm in the scene frame.

    Attributes:
        position: (3,) point on the floor below the base axis, metres.
        yaw: Heading about z, radians; 0 faces the plants (+x).
        shoulder_height: Height of the shoulder joint above that point, metres.
    """

    position: Vector = Field(default_factory=lambda: [0.0, 0.0, 0.0], validate_default=True)
    yaw: float = Field(default=0.0, ge=-100, le=100)
    shoulder_height: float = Field(default=1.1, gt=0, le=10)

    @model_validator(mode="after")
    def _within_bounds(self) -> ArmPlacement:
        if np.abs(self.position).max() > MAX_SIZE:
            raise InvalidValueError(f"position {self.position.tolist()} is farther than {MAX_SIZE:g} m from the origin")
        return self


class Shapes(Part):
    """Tomatoes, stems and clutter around an arm, in the scene frame."""

    tomatoes: tuple[Tomato, ...] = Field(default=(), max_length=MAX_TOMATOES)
    stems: tuple[Stem, ...] = Field(default=(), max_length=MAX_SHAPES)
    clutter: tuple[Sphere | Capsule | Box, ...] = Field(default=(), max_length=MAX_SHAPES)

    @model_validator(mode="after")
    def _within_bounds(self) -> Self:
        if _largest_number(self.obstacles) > MAX_SIZE:
            parts = {
                "tomatoes": [tomato.shape for tomato in self.tomatoes],
                "stems": self.stems,
                "clutter": self.clutter,
            }
            for name, shapes in parts.items():
                for i, shape in enumerate(shapes):
                    if _largest_number([shape]) > MAX_SIZE:
                        raise InvalidValueError(f"{name}.{i} is larger, or farther away, than {MAX_SIZE:g} m: {shape}")
        return self

    @property
    def obstacles(self) -> tuple[Shape, ...]:
        """All shapes in this order: tomatoes, stems, clutter."""
        return (*(tomato.shape for tomato in self.tomatoes), *self.stems, *self.clutter)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self._summary())})"

    __str__ = __repr__

    def _summary(self) -> list[str]:
        """Return the parts of its text."""
        parts = {"tomatoes": self.tomatoes, "stems": self.stems, "pieces of clutter": self.clutter}
        return [f"{len(shapes)} {name}" for name, shapes in parts.items()]

    def compact(self) -> Shapes:
        """Return the shapes as a scene file stores its truth: rounded to 0.1 mm, clutter sorted by type."""
        return _unpacked(_packed(self))


def _largest_number(shapes: Sequence[Shape]) -> float:
    """Return the largest absolute coordinate or size in shapes, metres."""
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
"""Shapes that files store as compressed tables (`greenhouse_gym.crops.shape_tables`), rounded to 0.1 mm."""


class Surroundings(Shapes):
    """Named obstacles and the arm's placement among them, from which collision models are compiled."""

    name: SceneName
    placement: ArmPlacement = Field(default_factory=ArmPlacement)

    def _summary(self) -> list[str]:
        return [repr(self.name), *super()._summary()]
