"""A bank of scenes: a folder with ``manifest.json`` and one JSON file per scene, split by row."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Literal, get_args, overload

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError, require_choice
from greenhouse_gym.paths import checked_name, data_path, first_fault, inside, parsing, read_bytes, write_atomically
from greenhouse_gym.scene.scene import Scene
from greenhouse_gym.scene.surroundings import SceneName

Split = Literal["train", "validation", "test"]
SPLITS: tuple[str, ...] = get_args(Split)
MANIFEST = "manifest.json"


class Entry(BaseModel):
    """One scene of a bank: file (relative to the manifest), checksum, row, growth week, split and size of its truth."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: SceneName
    file: str
    sha256: str
    row: str
    week: int | None
    split: Split
    truth: int | None = Field(default=None, ge=0, exclude_if=lambda value: value is None)


class Manifest(BaseModel):
    """What ``manifest.json`` holds. Scenes of one row never fall into two splits."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: Literal[1] = 1
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
        names = [entry.name for entry in self.scenes]
        if len(set(names)) != len(names):
            raise InvalidValueError("two scenes have the same name")
        return self


class SceneBank(Sequence[Scene]):
    """A sequence of scenes that are read when they are asked for and kept.

    Attributes:
        path: The bank's folder.
        manifest: What its manifest says.
    """

    def __init__(self, path: Path, manifest: Manifest):
        self.path = path
        self.manifest = manifest
        self._entries = {entry.name: entry for entry in manifest.scenes}
        self._scenes: dict[str, Scene] = {}

    @classmethod
    def open(cls, bank: str | Path | SceneBank = "default") -> SceneBank:
        """Open a shipped bank by name or any bank by its folder.

        Raises:
            UnknownNameError: Neither a shipped name nor a folder.
            FileFormatError: The manifest is missing or damaged.
        """
        if isinstance(bank, SceneBank):
            return bank
        shipped = {path.parent.name: path.parent for path in sorted(data_path("scenes").glob(f"*/{MANIFEST}"))}
        folder = shipped.get(str(bank)) or Path(bank)
        if not folder.is_dir():
            raise UnknownNameError("scene bank", str(bank), [*shipped, "(or the path of a bank's folder)"])
        folder = folder.resolve()
        return _opened(folder, read_bytes(folder / MANIFEST, "bank manifest"))

    @property
    def sha256(self) -> str:
        """The manifest's checksum, and so, through the checksums in it, that of all scenes."""
        return hashlib.sha256(read_bytes(self.path / MANIFEST, "bank manifest")).hexdigest()

    def names(self, split: str | None = None) -> list[str]:
        """Names of the scenes, all of them or those of one split, in the manifest's order."""
        if split is not None:
            require_choice("split", split, SPLITS)
        return [entry.name for entry in self.manifest.scenes if split in (None, entry.split)]

    def split_of(self, name: str) -> str:
        """The split a scene belongs to."""
        return self._entry(name).split

    def largest_truth(self) -> int | None:
        """Most shapes in the truth of a scene; None where no scene carries its truth."""
        return max((entry.truth for entry in self.manifest.scenes if entry.truth is not None), default=None)

    def scene(self, name: str) -> Scene:
        """A scene by its name.

        Raises:
            UnknownNameError: The bank has no such scene.
            FileFormatError: Its file is missing, damaged, or not the one the manifest was written for.
        """
        entry = self._entry(name)
        if name not in self._scenes:
            path = inside(self.path, entry.file, named_in=self.path / MANIFEST)
            content = read_bytes(path, "scene")
            scene = Scene.parse(content, path)
            if hashlib.sha256(content).hexdigest() != entry.sha256:
                raise FileFormatError(path, f"checksum differs from the one in {self.path / MANIFEST}")
            self._scenes[name] = scene
        return self._scenes[name]

    def _entry(self, name: str) -> Entry:
        if name not in self._entries:
            raise UnknownNameError("scene", name, self._entries)
        return self._entries[name]

    def __len__(self) -> int:
        return len(self.manifest.scenes)

    @overload
    def __getitem__(self, index: int) -> Scene: ...
    @overload
    def __getitem__(self, index: slice) -> list[Scene]: ...
    def __getitem__(self, index: int | slice) -> Scene | list[Scene]:
        chosen = self.manifest.scenes[index]
        return self.scene(chosen.name) if isinstance(chosen, Entry) else [self.scene(entry.name) for entry in chosen]


@lru_cache(maxsize=16)
def _opened(folder: Path, content: bytes) -> SceneBank:
    """The bank of a folder whose manifest holds ``content``: kept, so that its scenes are read once."""
    with parsing(folder / MANIFEST, "bank manifest"):
        return SceneBank(folder, Manifest.model_validate_json(content))


def write_bank(folder: str | Path, scenes: Iterable[tuple[Scene, str]], name: str, description: str = "") -> SceneBank:
    """Write scenes, each with its split, as a bank: scene files first, the manifest last.

    Args:
        folder: Where the bank goes; made if missing. Scene files that the new manifest does not name stay.
        scenes: Pairs of a scene and its split.
        name: Name of the bank.
        description: A sentence on where it comes from.

    Raises:
        InvalidValueError: A row lies in two splits, two scenes share a name, or a name is no safe file name; nothing is
            written then.
    """
    folder = Path(folder).resolve()
    contents: list[tuple[Path, str]] = []
    entries: list[Entry] = []
    for scene, split in scenes:
        require_choice("split", split, SPLITS)
        checked_name("a scene", scene.name)  # copies of a scene with another name are not validated
        content = scene.model_dump_json() + "\n"
        entries.append(
            Entry(
                name=scene.name,
                file=f"{scene.name}.json",
                sha256=hashlib.sha256(content.encode()).hexdigest(),
                row=scene.provenance.row,
                week=scene.provenance.week,
                split=split,  # type: ignore[arg-type]
                truth=None if scene.truth is None else len(scene.truth.obstacles),
            )
        )
        contents.append((folder / entries[-1].file, content))
    try:
        manifest = Manifest(name=name, description=description, scenes=tuple(entries))
    except ValidationError as error:
        raise InvalidValueError(f"{folder}: {first_fault(error)}") from error
    for path, content in contents:
        write_atomically(path, content)
    write_atomically(folder / MANIFEST, manifest.model_dump_json(indent=1) + "\n")
    return SceneBank(folder, manifest)
