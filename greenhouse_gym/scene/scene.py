"""The scene file: tomatoes, stems, clutter, where the arm stands, targets with certificates, provenance."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, get_args

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

from greenhouse_gym.crop import Stem, Tomato
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box, Capsule, Shape, Sphere, Vector
from greenhouse_gym.paths import checked_name, parsing, read_bytes, write_atomically
from greenhouse_gym.scene.packed import pack, unpack
from greenhouse_gym.scene.seen import SeenSpace

if TYPE_CHECKING:
    from greenhouse_gym.robots import Robot

Difficulty = Literal["easy", "medium", "hard", "unreachable"]
DIFFICULTIES: tuple[str, ...] = get_args(Difficulty)

MOST_TOMATOES, MOST_SHAPES = 2000, 50_000
"""The most tomatoes, and the most stems and the most pieces of clutter, that a scene may hold."""

LARGEST = 100.0
"""The largest coordinate or size in a scene, metres: single precision still resolves a hundredth of a millimetre."""

SceneName = Annotated[str, AfterValidator(lambda name: checked_name("a scene", name))]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Stand(_Part):
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


class Target(_Part):
    """A tomato as a reaching target.

    Attributes:
        tomato: Index into `Scene.tomatoes`.
        difficulty: One of `DIFFICULTIES`.
        robot: The arm the certificate is for.
        witness: A checked collision-free joint path (k, joints) in radians from the arm's start to the target, or None
            where none was found.
    """

    tomato: int = Field(ge=0)
    difficulty: Difficulty
    robot: str = "ur5e"
    witness: tuple[tuple[float, ...], ...] | None = None


class Provenance(_Part):
    """Where a scene comes from: recording, settings, package version, row, station, growth week."""

    row: str
    station: int | None = None
    week: int | None = None
    recording: str | None = None
    recording_sha256: str | None = None
    settings: dict[str, Any] = Field(default_factory=dict)
    package_version: str | None = None


class Shapes(_Part):
    """Tomatoes, stems and clutter in the scene frame: what stands around the arm."""

    tomatoes: tuple[Tomato, ...] = Field(default=(), max_length=MOST_TOMATOES)
    stems: tuple[Stem, ...] = Field(default=(), max_length=MOST_SHAPES)
    clutter: tuple[Sphere | Capsule | Box, ...] = Field(default=(), max_length=MOST_SHAPES)

    @model_validator(mode="after")
    def _not_large(self) -> Self:
        for kind in ("tomatoes", "stems", "clutter"):
            for i, shape in enumerate(getattr(self, kind)):
                lengths = [value for value in vars(shape).values() if isinstance(value, np.ndarray | float)]
                if max(float(np.abs(value).max()) for value in lengths) > LARGEST:
                    raise InvalidValueError(f"{kind}.{i} is larger, or farther away, than {LARGEST:g} m: {shape}")
        return self

    @property
    def obstacles(self) -> tuple[Shape, ...]:
        """All shapes in one order: tomatoes, stems, clutter."""
        return (*self.tomatoes, *self.stems, *self.clutter)

    def compact(self) -> Shapes:
        """The shapes as a scene file keeps those of its truth: to 0.1 mm, the clutter sorted by kind."""
        return _unpacked(_packed(self))


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


class Scene(Shapes):
    """One place in a row with an arm in front of it.

    The frame is the world frame of the package: z up, y along the row, x from the aisle into the plants, origin on
    the floor below the arm. Lengths are metres, angles radians.

    Attributes:
        truth: What really stands there, where that is known: all of a simulated row within the arm's reach.
        seen: What the scan saw of the space around the arm: ``scene.seen(points)`` tells seen points from unseen ones.
            None where it is not known.
    """

    schema_version: Literal[1] = 1
    name: SceneName
    stand: Stand = Field(default_factory=Stand)
    targets: tuple[Target, ...] = ()
    provenance: Provenance
    truth: PackedShapes | None = None
    seen: SeenSpace | None = None

    @model_validator(mode="after")
    def _targets_exist(self) -> Scene:
        for target in self.targets:
            if target.tomato >= len(self.tomatoes):
                raise InvalidValueError(f"target names tomato {target.tomato}, the scene has {len(self.tomatoes)}")
        return self

    @classmethod
    def load(cls, path: str | Path) -> Scene:
        """Read a scene from its JSON file.

        Raises:
            FileFormatError: The file is missing, is not JSON, or breaks the schema; the message names the field.
        """
        return cls.parse(read_bytes(path, "scene"), path)

    @classmethod
    def parse(cls, content: bytes, path: str | Path) -> Scene:
        """A scene from the content of its file; ``path`` is named in the error."""
        with parsing(path, "scene"):
            return cls.model_validate_json(content)

    def save(self, path: str | Path) -> Path:
        """Write the scene as JSON (to a temporary name, then renamed) and return the path."""
        return write_atomically(path, self.model_dump_json(indent=None) + "\n")

    def to_mjcf(self, robot: str | Robot | None = None, target: int | None = None) -> str:
        """The scene as an XML text that plain MuJoCo opens.

        Args:
            robot: Name, file or `Robot`; None leaves the arm out.
            target: Index of the tomato that the cup may touch: contacts are then those the environment judges by.

        Raises:
            InvalidValueError: The scene has no such tomato.
        """
        from greenhouse_gym.scene.mjcf import scene_spec

        spec = scene_spec(self, robot, target=target)
        spec.compile()  # MuJoCo writes XML from a compiled specification only
        xml: str = spec.to_xml()
        return xml
