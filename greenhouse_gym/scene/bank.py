"""A bank of scenes: a folder with ``manifest.json`` and one JSON file per scene, split by row."""

from __future__ import annotations

import hashlib
import os
import weakref
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from numbers import Integral
from pathlib import Path
from typing import Any, overload

from greenhouse_gym.common.files import checked_name, data_path, inside, parsing, read_bytes, resolved, write_atomically
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError, require_choice
from greenhouse_gym.scene.manifest import (
    MANIFEST,
    SPLITS,
    Manifest,
    SceneEntry,
    make_manifest,
    manifest_text,
    target_counts,
)
from greenhouse_gym.scene.scene import Difficulty, Scene

Choice = str | int | Iterable[str | int] | None
"""One value, several values, or None for all."""

SCENES_KEPT = 32
"""Number of recently used scenes of a bank kept in memory, in addition to those in use elsewhere."""


def shipped_banks() -> dict[str, Path]:
    """Return the folders of the shipped banks by name."""
    return {path.parent.name: path.parent for path in sorted(data_path("scenes").glob(f"*/{MANIFEST}"))}


class SceneBank(Sequence[Scene]):
    """A sequence of scenes that are read on demand; recently used scenes are cached.

    Attributes:
        path: The bank's folder; for joined banks, that of the first.
        manifest: Content of its manifest.
    """

    def __init__(self, path: Path, manifest: Manifest, homes: Mapping[str, SceneBank] | None = None):
        self.path = path
        self.manifest = manifest
        self._homes = homes or {}  # for a selection or a union of banks: the bank that reads each scene
        self._entries = {entry.name: entry for entry in manifest.scenes}
        self._alive: weakref.WeakValueDictionary[str, Scene] = weakref.WeakValueDictionary()
        self._scenes: OrderedDict[str, Scene] = OrderedDict()

    @classmethod
    def open(cls, bank: str | Path | SceneBank = "default") -> SceneBank:
        """Open a shipped bank by name or any bank by its folder; a `SceneBank` is returned unchanged.

        Raises:
            UnknownNameError: The argument is neither a shipped name nor a folder.
            FileFormatError: The manifest is missing or damaged.
        """
        if isinstance(bank, SceneBank):
            return bank
        shipped = shipped_banks()
        folder = resolved(shipped.get(str(bank)) or bank)
        if not os.path.isdir(folder):  # noqa: PTH112, because `Path.is_dir` raises an error for long names
            raise UnknownNameError("scene bank", str(bank), [*shipped, "(or the path of a bank's folder)"])
        return _opened(folder, read_bytes(folder / MANIFEST, "bank manifest"))

    @classmethod
    def join(cls, banks: Iterable[str | Path | SceneBank], name: str = "") -> SceneBank:
        """Join banks; only their manifests are read, and nothing is written.

        Args:
            banks: Names, folders or banks.
            name: Name of the joined bank; by default the names of all banks.

        Raises:
            InvalidValueError: There are no banks, two scenes share a name, or a row is in two splits.
        """
        opened = [cls.open(bank) for bank in banks]
        if not opened:
            raise InvalidValueError("expected at least one bank to join")
        named = name or "+".join(bank.manifest.name for bank in opened)
        entries = tuple(entry for bank in opened for entry in bank.manifest.scenes)
        homes = {entry.name: bank for bank in opened for entry in bank.manifest.scenes}
        folders = ", ".join(str(bank.path) for bank in opened)
        return cls(opened[0].path, make_manifest(named, f"Joined of {folders}", entries, folders), homes)

    def select(
        self,
        split: Choice = None,
        row: Choice = None,
        week: Choice = None,
        style: Choice = None,
        source: Choice = None,
        protocol: Choice = None,
        difficulty: Choice = None,
    ) -> SceneBank:
        """Select the scenes that meet all given conditions, as a bank; splits stay unchanged.

        Args:
            split: Splits.
            row: Names of rows.
            week: Growth weeks.
            style: Fruit styles.
            source: Sources of the plants.
            protocol: Capture protocols; scenes without one count as the paper's.
            difficulty: Difficulties; scenes with at least one such target are selected.

        Raises:
            UnknownNameError: No scene of the bank has a value; the message lists the choices.
            InvalidValueError: No scene meets all conditions.
        """
        conditions = {"split": split, "row": row, "week": week, "style": style, "source": source, "protocol": protocol}
        wanted = {
            kind: _several(value)
            for kind, value in (*conditions.items(), ("difficulty", difficulty))
            if value is not None
        }
        kept = [(entry, self._kinds(entry)) for entry in self.manifest.scenes]
        for kind, values in wanted.items():
            known = {value for _, kinds in kept for value in kinds[kind]}
            for value in values:
                require_choice(kind, value, sorted(known, key=int) if kind == "week" else sorted(known))
        chosen = tuple(entry for entry, kinds in kept if all(kinds[kind] & values for kind, values in wanted.items()))
        if not chosen:
            raise InvalidValueError(f"bank {self.path} has no scene with {_described(wanted)}")
        description = f"{self.manifest.description} Selected: {_described(wanted)}."
        manifest = make_manifest(self.manifest.name, description, chosen, self.path)
        return SceneBank(self.path, manifest, {entry.name: self for entry in chosen})

    def difficulties(self, name: str) -> dict[Difficulty, int]:
        """Return the number of targets of each difficulty in a scene, which is read only if the manifest omits them."""
        entry = self._entry(name)
        return target_counts(self.scene(name)) if entry.targets is None else entry.targets

    def _kinds(self, entry: SceneEntry) -> dict[str, set[str]]:
        """Return the values of a scene for the conditions of `select`."""
        values = {
            "split": entry.split,
            "row": entry.row,
            "week": entry.week,
            "style": entry.style,
            "source": entry.source,
            "protocol": entry.protocol or "paper",
        }
        kinds = {kind: set() if value is None else {str(value)} for kind, value in values.items()}
        return kinds | {"difficulty": {str(name) for name, count in self.difficulties(entry.name).items() if count}}

    def __reduce__(self) -> tuple[Callable[..., SceneBank], tuple[Any, ...]]:
        # a bank is pickled as its folder, a selection or union as its entries and the banks that read them
        return (SceneBank, (self.path, self.manifest, self._homes)) if self._homes else (SceneBank.open, (self.path,))

    def __repr__(self) -> str:
        splits = Counter(str(entry.split) for entry in self.manifest.scenes)
        counts = ", ".join(f"{splits[split]} {split}" for split in SPLITS if splits[split])
        return f"SceneBank({self.manifest.name!r}, {len(self)} scenes: {counts}, {str(self.path)!r})"

    @property
    def sha256(self) -> str:
        """Checksum of the manifest, which covers all scenes through the checksums in it."""
        return hashlib.sha256(manifest_text(self.manifest).encode()).hexdigest()

    def names(self, split: str | None = None) -> list[str]:
        """Return the names of all scenes or those of one split, in the manifest's order."""
        if split is not None:
            require_choice("split", split, SPLITS)
        return [entry.name for entry in self.manifest.scenes if split in (None, entry.split)]

    def split_of(self, name: str) -> str:
        """Return the split of a scene."""
        return self._entry(name).split

    def largest_scene(self) -> int | None:
        """Return the maximum number of shapes of a scene without its truth, or None if the manifest omits it."""
        return max((entry.shapes for entry in self.manifest.scenes if entry.shapes is not None), default=None)

    def largest_truth(self) -> int | None:
        """Return the maximum number of shapes in the truth of a scene, or None if no scene has truth."""
        return max((entry.truth for entry in self.manifest.scenes if entry.truth is not None), default=None)

    def scene(self, name: str) -> Scene:
        """Read a scene by its name.

        Raises:
            UnknownNameError: The bank has no such scene.
            FileFormatError: Its file is missing or damaged, or its checksum differs from the manifest's.
        """
        entry = self._entry(name)
        if name in self._homes:
            return self._homes[name].scene(name)
        scene = self._alive.get(name)
        if scene is None:
            scene = self._alive[name] = self._read(entry)
        self._scenes[name] = scene
        self._scenes.move_to_end(name)
        if len(self._scenes) > SCENES_KEPT:
            self._scenes.popitem(last=False)
        return scene

    def _read(self, entry: SceneEntry) -> Scene:
        path = inside(self.path, entry.file, named_in=self.path / MANIFEST)
        content = read_bytes(path, "scene")
        known = hashlib.sha256(content).hexdigest() == entry.sha256
        scene = Scene.parse(content, path, defer=known)
        if not known:  # whatever else is wrong with the file is more telling
            raise FileFormatError(path, f"checksum differs from the one in {self.path / MANIFEST}")
        return scene

    def _entry(self, name: str) -> SceneEntry:
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
        return (
            self.scene(chosen.name) if isinstance(chosen, SceneEntry) else [self.scene(entry.name) for entry in chosen]
        )


@lru_cache(maxsize=16)
def _opened(folder: Path, content: bytes) -> SceneBank:
    """Return the bank of a folder whose manifest holds ``content``; cached, so that its scenes are read once."""
    with parsing(folder / MANIFEST, "bank manifest"):
        return SceneBank(folder, Manifest.model_validate_json(content))


def write_bank(folder: str | Path, scenes: Iterable[tuple[Scene, str]], name: str, description: str = "") -> SceneBank:
    """Write scenes, each with its split, as a bank: scene files first, the manifest last.

    Args:
        folder: Folder of the bank, created if missing. Scene files that the new manifest does not name stay.
        scenes: Pairs of a scene and its split.
        name: Name of the bank.
        description: A sentence on its origin.

    Raises:
        InvalidValueError: A row is in two splits, two scenes share a name, or a name is no safe file name; nothing is
            written then.
    """
    folder = resolved(folder)
    contents: list[tuple[Path, str]] = []
    entries: list[SceneEntry] = []
    for scene, split in scenes:
        require_choice("split", split, SPLITS)
        checked_name("a scene", scene.name)  # renamed copies of a scene are not validated
        content = scene.model_dump_json() + "\n"
        entries.append(
            SceneEntry(
                name=scene.name,
                file=f"{scene.name}.json",
                sha256=hashlib.sha256(content.encode()).hexdigest(),
                row=scene.provenance.row,
                week=scene.provenance.week,
                split=split,  # type: ignore[arg-type]
                shapes=scene.count,
                truth=None if scene.truth is None else scene.truth.count,
                style=scene.provenance.style,
                source=scene.provenance.source,
                protocol=scene.provenance.protocol,
                targets=target_counts(scene),
            )
        )
        path = folder / entries[-1].file
        if not _holds(path, content):  # a build has already written its scenes, which may exceed memory
            contents.append((path, content))
    manifest = make_manifest(name, description, tuple(entries), folder)
    for path, content in contents:
        write_atomically(path, content)
    write_atomically(folder / MANIFEST, manifest_text(manifest))
    return SceneBank(folder, manifest)


def _holds(path: Path, content: str) -> bool:
    try:
        return path.read_bytes() == content.encode()
    except OSError:
        return False


def _several(choice: str | int | Iterable[str | int]) -> set[str]:
    if isinstance(choice, str | int | Integral):  # NumPy's integers as well
        return {str(choice)}
    return {str(value) for value in choice}


def _described(wanted: Mapping[str, set[str]]) -> str:
    return "; ".join(f"{kind} {' or '.join(sorted(values))}" for kind, values in wanted.items()) or "everything"
