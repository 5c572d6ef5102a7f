"""The scene file: obstacles, the arm's placement, targets with certificates, provenance."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from pydantic import Field, model_validator

from greenhouse_gym.common.files import parsing, read_bytes, write_atomically
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.scene.obstacles import PackedShapes, Part, SchemaVersion, Surroundings, is_none
from greenhouse_gym.scene.occupancy import OccupancyGrid

if TYPE_CHECKING:
    from greenhouse_gym.robots import Robot

Difficulty = Literal["easy", "medium", "hard", "unreachable"]
DIFFICULTIES: tuple[str, ...] = get_args(Difficulty)


class BrushCertificate(Part):
    """Rating of a target where leaves give way to an arm that brushes them.

    Attributes:
        difficulty: One of `DIFFICULTIES`, by the same rule.
        witness: As `Target.witness`; None if none was found, or if the target's own witness holds, which brushes no
            leaf.
        leaves: Number of shapes of leaves that the witness brushes.
    """

    difficulty: Difficulty
    witness: tuple[tuple[float, ...], ...] | None = Field(default=None, repr=False, exclude_if=is_none)
    leaves: int = Field(default=0, ge=0)


class Target(Part):
    """A tomato as a reaching target.

    Attributes:
        tomato: Index into `Scene.tomatoes`.
        difficulty: One of `DIFFICULTIES`.
        robot: The arm the certificate is for.
        witness: A checked collision-free joint path (k, joints) in radians from `Robot.rating_start` to the target, or
            None if none was found.
        goals: Number of distinct free goal configurations that were found, at most
            `greenhouse_gym.planning.certify.GOALS`.
        checks: Median over several seeds of the collision checks RRTConnect needed for a path. None for easy targets,
            which need no planner, and if most seeds failed.
        clearance: Minimum distance of the arm to any obstacle except the target along the witness, metres.
        unknown: Fraction of the tip's path along the witness during which part of the arm is in unknown space; None
            without an occupancy grid.
        brush: Rating where leaves give way, or None if it is unknown. A target that is unreachable by both ratings is
            out of reach or behind fruit, stems or fixtures; one by its own rating alone is behind leaves.
    """

    tomato: int = Field(ge=0)
    difficulty: Difficulty
    robot: str = "ur5e"
    witness: tuple[tuple[float, ...], ...] | None = Field(default=None, repr=False)
    goals: int | None = Field(default=None, ge=0, exclude_if=is_none)
    checks: int | None = Field(default=None, ge=0, exclude_if=is_none)
    clearance: float | None = Field(default=None, exclude_if=is_none)
    unknown: float | None = Field(default=None, ge=0, le=1, exclude_if=is_none)
    brush: BrushCertificate | None = Field(default=None, exclude_if=is_none)


class Provenance(Part):
    """Origin of a scene: recording, settings, package version, row, station, growth week.

    Attributes:
        style: Fruit style, if known.
        source: Source of the plants, as `greenhouse_gym.crops.grow_row` names it, or "real".
        protocol: Capture protocol of the recording.
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
    """A stretch of a row with an arm in front of it.

    The frame is the world frame of the package: z up, y along the row, x from the aisle into the plants, origin on
    the floor below the arm. Lengths are metres, angles radians.

    Attributes:
        truth: True obstacles within the arm's reach, if known: those of a simulated row.
        occupancy: Occupancy grid of the scan, or None: ``scene.occupancy.is_known(points)``.
    """

    schema_version: SchemaVersion = 1
    targets: tuple[Target, ...] = ()
    provenance: Provenance
    truth: PackedShapes | None = None
    occupancy: OccupancyGrid | None = None

    @model_validator(mode="after")
    def _targets_exist(self) -> Scene:
        for target in self.targets:
            if target.tomato >= self.counts[0]:
                raise InvalidValueError(f"target names tomato {target.tomato}, the scene has {self.counts[0]}")
        return self

    def _summary(self) -> list[str]:
        ratings = Counter(str(target.difficulty) for target in self.targets)
        rated = ", ".join(f"{ratings[name]} {name}" for name in DIFFICULTIES if ratings[name])
        targets = f"{len(self.targets)} targets{f' ({rated})' if rated else ''}"
        known = [name for name in ("truth", "occupancy") if getattr(self, name) is not None]
        return [*super()._summary(), targets, *known]

    @classmethod
    def load(cls, path: str | Path) -> Scene:
        """Read a scene from its JSON file.

        Raises:
            FileFormatError: The file is missing, is not JSON, or breaks the schema; the message names the field.
        """
        return cls.parse(read_bytes(path, "scene"), path)

    @classmethod
    def parse(cls, content: bytes, path: str | Path, defer: bool = False) -> Scene:
        """Read a scene from the content of its file.

        Args:
            content: The content.
            path: The file, which error messages name.
            defer: Unpack the truth and the occupancy grid, most of the work, when they are first used. For content
                that a checksum covers: damage is found no sooner.

        Raises:
            FileFormatError: The content is damaged.
        """
        with parsing(path, "scene"):
            return cls.model_validate_json(content, context={"path": path} if defer else None)

    def save(self, path: str | Path) -> Path:
        """Write the scene as JSON (to a temporary name, then renamed) and return the path."""
        return write_atomically(path, self.model_dump_json(indent=None) + "\n")

    def to_mjcf(self, robot: str | Robot | None = None, target: int | None = None) -> str:
        """Return the scene as XML that plain MuJoCo opens.

        Args:
            robot: Name, file or `Robot`; None leaves the arm out.
            target: Index of the tomato that the cup may touch, so that contacts are those the environment counts.

        Raises:
            InvalidValueError: The scene has no such tomato.
        """
        from greenhouse_gym.scene.mjcf import scene_spec

        spec = scene_spec(self, robot, target=target)
        spec.compile()  # MuJoCo writes XML only from a compiled specification
        xml: str = spec.to_xml()
        return xml
