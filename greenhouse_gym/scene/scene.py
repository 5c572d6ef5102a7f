"""The scene file: tomatoes, stems, clutter, where the arm stands, targets with certificates, provenance."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from pydantic import Field, model_validator

from greenhouse_gym.common.files import parsing, read_bytes, write_atomically
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.scene.obstacles import PackedShapes, Part, SchemaVersion, Surroundings, is_none
from greenhouse_gym.scene.occupancy import SeenSpace

if TYPE_CHECKING:
    from greenhouse_gym.robots import Robot

Difficulty = Literal["easy", "medium", "hard", "unreachable"]
DIFFICULTIES: tuple[str, ...] = get_args(Difficulty)


class Target(Part):
    """A tomato as a reaching target.

    Attributes:
        tomato: Index into `Scene.tomatoes`.
        difficulty: One of `DIFFICULTIES`.
        robot: The arm the certificate is for.
        witness: A checked collision-free joint path (k, joints) in radians from the arm's start to the target, or None
            where none was found.
        goals: Number of distinct free goal configurations that were found, `greenhouse_gym.planning.certify.GOALS` at
            most.
        checks: Collision checks RRTConnect needed for a path, the median over some seeds; None where most of them
            failed, for easy targets, which need no planner, and in banks that were built before this was noted.
        clearance: Smallest distance of the arm to any obstacle but the target along the witness, metres.
        unseen: Share of the tip's way along the witness on which some of the arm is in space that the scan did not see;
            None where that is not known.
    """

    tomato: int = Field(ge=0)
    difficulty: Difficulty
    robot: str = "ur5e"
    witness: tuple[tuple[float, ...], ...] | None = None
    goals: int | None = Field(default=None, ge=0, exclude_if=is_none)
    checks: int | None = Field(default=None, ge=0, exclude_if=is_none)
    clearance: float | None = Field(default=None, exclude_if=is_none)
    unseen: float | None = Field(default=None, ge=0, le=1, exclude_if=is_none)


class Provenance(Part):
    """Where a scene comes from: recording, settings, package version, row, station, growth week.

    Attributes:
        style: Fruit style, where it is known.
        source: Where the plants come from, as `greenhouse_gym.plants.grow_row` has it, or "real".
        protocol: How the row was photographed.
    """

    row: str
    station: int | None = None
    week: int | None = None
    style: str | None = Field(default=None, exclude_if=is_none)
    source: str | None = Field(default=None, exclude_if=is_none)
    protocol: str | None = Field(default=None, exclude_if=is_none)
    recording: str | None = None
    recording_sha256: str | None = None
    settings: dict[str, Any] = Field(default_factory=dict)
    package_version: str | None = None


class Scene(Surroundings):
    """One place in a row with an arm in front of it.

    The frame is the world frame of the package: z up, y along the row, x from the aisle into the plants, origin on
    the floor below the arm. Lengths are metres, angles radians.

    Attributes:
        truth: What really stands there, where that is known: all of a simulated row within the arm's reach.
        seen: What the scan saw of the space around the arm: ``scene.seen(points)`` tells seen points from unseen ones.
            None where it is not known.
    """

    schema_version: SchemaVersion = 1
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
