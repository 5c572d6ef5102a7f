"""What a tomato row is made of, shared by truth, extraction and scenes: tomatoes and stems."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from pydantic import Field

from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Capsule, Ellipsoid, Rotation, Sphere, Vector

StemKind = Literal["main", "peduncle", "pedicel", "string", "pipe"]
STEM_KINDS: tuple[str, ...] = get_args(StemKind)

_LEFT_OUT = Field(exclude_if=lambda value: value is None)  # round tomatoes are written without


@dataclass(frozen=True, eq=False)
class Tomato(Sphere):
    """A tomato: a sphere, or an ellipsoid, with the number of its truss and its ripeness.

    Attributes:
        truss: Number of the truss it hangs on, unique within a row or scene.
        ripeness: 0 (green) to 1 (red), or None when unknown.
        semi_axes: (3,) metres, for an ellipsoid; its ``radius`` is then the cube root of their product.
        rotation: (3, 3) scene_from_tomato of an ellipsoid.
    """

    truss: int
    ripeness: float | None = None
    semi_axes: Annotated[Vector | None, _LEFT_OUT] = None
    rotation: Annotated[Rotation | None, _LEFT_OUT] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ripeness is not None and not 0.0 <= self.ripeness <= 1.0:
            raise InvalidValueError(f"ripeness must be between 0 and 1, got {self.ripeness!r}")
        if (self.semi_axes is None) != (self.rotation is None):
            raise InvalidValueError(
                "a tomato that is an ellipsoid has both semi_axes and rotation, a round one neither"
            )
        if (ellipsoid := self.ellipsoid) is not None:
            if abs(ellipsoid.radius - self.radius) > 1e-4:
                raise InvalidValueError(
                    f"radius must be that of the same volume, {ellipsoid.radius:.5f}, got {self.radius!r}"
                )
            object.__setattr__(self, "semi_axes", ellipsoid.semi_axes)
            object.__setattr__(self, "rotation", ellipsoid.rotation)

    @property
    def ellipsoid(self) -> Ellipsoid | None:
        """The ellipsoid that it is; None for a round one."""
        if self.semi_axes is None or self.rotation is None:
            return None
        return Ellipsoid(self.center, self.semi_axes, self.rotation)


@dataclass(frozen=True, eq=False)
class Stem(Capsule):
    """A straight piece of stem: a capsule with its kind, one of `STEM_KINDS`."""

    kind: StemKind

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice("stem kind", self.kind, STEM_KINDS)
