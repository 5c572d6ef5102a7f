"""Content of a bank's ``manifest.json``: an entry per scene, and its consistency."""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Literal, TypeVar, get_args

from pydantic import ConfigDict, Field, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from greenhouse_gym.common.files import first_fault
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.scene.obstacles import Part, SceneName, SchemaVersion, is_none
from greenhouse_gym.scene.scene import Difficulty, Scene

Split = Literal["train", "validation", "test"]

SPLITS: tuple[str, ...] = get_args(Split)
MANIFEST = "manifest.json"


Value = TypeVar("Value")
Optional = Annotated[Value | None, Field(exclude_if=is_none)]
"""A field that an entry may omit."""


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class SceneEntry:
    """One scene of a bank. A dataclass is read twice as fast as a model.

    Attributes:
        name: Name of the scene.
        file: Its file, relative to the manifest.
        sha256: Checksum of the file.
        row: Name of the row, equal in all weeks.
        week: Growth week.
        split: Split of the row.
        shapes: Number of shapes in the scene.
        truth: Number of shapes in its truth.
        style: Fruit style.
        source: Source of the plants.
        protocol: Capture protocol.
        targets: Number of targets of each difficulty.
    """

    name: SceneName
    file: str
    sha256: str
    row: str
    week: int | None
    split: Split
    shapes: Optional[Annotated[int, Field(ge=0)]] = None
    truth: Optional[Annotated[int, Field(ge=0)]] = None
    style: Optional[str] = None
    source: Optional[str] = None
    protocol: Optional[str] = None
    targets: Optional[dict[Difficulty, int]] = None


class Manifest(Part):
    """Content of ``manifest.json``. Scenes of one row are never in two splits."""

    schema_version: SchemaVersion = 1
    name: str
    description: str = ""
    scenes: tuple[SceneEntry, ...]

    @model_validator(mode="after")
    def _consistent(self) -> Manifest:
        split_of_row: dict[str, str] = {}
        for entry in self.scenes:
            if split_of_row.setdefault(entry.row, entry.split) != entry.split:
                raise InvalidValueError(f"row {entry.row!r} is in two splits: {split_of_row[entry.row]}, {entry.split}")
        names = Counter(entry.name for entry in self.scenes)
        if len(names) != len(self.scenes):
            raise InvalidValueError(f"two scenes have the same name: {names.most_common(1)[0][0]!r}")
        return self


def target_counts(scene: Scene) -> dict[Difficulty, int]:
    """Return the number of targets of each difficulty in a scene."""
    return {name: sum(target.difficulty == name for target in scene.targets) for name in get_args(Difficulty)}


def manifest_text(manifest: Manifest) -> str:
    """Return the text of a manifest's file."""
    return manifest.model_dump_json(indent=1) + "\n"


def make_manifest(name: str, description: str, entries: tuple[SceneEntry, ...], where: object) -> Manifest:
    """Create a manifest.

    Raises:
        InvalidValueError: A row is in two splits, or two scenes share a name; the message names ``where``.
    """
    try:
        return Manifest(name=name, description=description, scenes=entries)
    except ValidationError as error:
        raise InvalidValueError(f"{where}: {first_fault(error)}") from error
