"""What a bank's ``manifest.json`` holds: an entry for each scene, and what must hold among them."""

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
Told = Annotated[Value | None, Field(exclude_if=is_none)]
"""What an entry may leave out."""


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class Entry:
    """One scene of a bank; a dataclass, which is read twice as fast as a model.

    Attributes:
        name: Name of the scene.
        file: Its file, relative to the manifest.
        sha256: Checksum of the file.
        row: Identity of the row; the same in all weeks.
        week: Growth week.
        split: Split of the row.
        shapes: Number of shapes in the scene; what was written before this was told does not say.
        truth: Number of shapes in the scene's truth.
        style: Fruit style.
        source: Where the plants come from.
        protocol: How the row was photographed.
        targets: How many targets the scene has of each difficulty.
    """

    name: SceneName
    file: str
    sha256: str
    row: str
    week: int | None
    split: Split
    shapes: Told[Annotated[int, Field(ge=0)]] = None
    truth: Told[Annotated[int, Field(ge=0)]] = None
    style: Told[str] = None
    source: Told[str] = None
    protocol: Told[str] = None
    targets: Told[dict[Difficulty, int]] = None


class Manifest(Part):
    """What ``manifest.json`` holds. Scenes of one row never fall into two splits."""

    schema_version: SchemaVersion = 1
    name: str
    description: str = ""
    scenes: tuple[Entry, ...]

    @model_validator(mode="after")
    def _consistent(self) -> Manifest:
        split_of_row: dict[str, str] = {}
        for entry in self.scenes:
            if split_of_row.setdefault(entry.row, entry.split) != entry.split:
                raise InvalidValueError(
                    f"row {entry.row!r} lies in two splits: {split_of_row[entry.row]}, {entry.split}"
                )
        names = Counter(entry.name for entry in self.scenes)
        if len(names) != len(self.scenes):
            raise InvalidValueError(f"two scenes have the same name: {names.most_common(1)[0][0]!r}")
        return self


def counted(scene: Scene) -> dict[Difficulty, int]:
    """How many targets of each difficulty a scene has, all of them named."""
    return {name: sum(target.difficulty == name for target in scene.targets) for name in get_args(Difficulty)}


def as_file(manifest: Manifest) -> str:
    """What a manifest's file holds."""
    return manifest.model_dump_json(indent=1) + "\n"


def manifest_of(name: str, description: str, entries: tuple[Entry, ...], where: object) -> Manifest:
    """A manifest.

    Raises:
        InvalidValueError: A row lies in two splits, or two scenes have one name; ``where`` is named in the message.
    """
    try:
        return Manifest(name=name, description=description, scenes=entries)
    except ValidationError as error:
        raise InvalidValueError(f"{where}: {first_fault(error)}") from error
