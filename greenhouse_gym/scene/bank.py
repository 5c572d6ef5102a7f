"""A bank of scenes: a folder with ``manifest.json`` and one JSON file per scene, split by row."""

from __future__ import annotations

import hashlib
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, overload

from greenhouse_gym.common.files import checked_name, data_path, inside, parsing, read_bytes, write_atomically
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError, require_choice
from greenhouse_gym.scene.manifest import MANIFEST, SPLITS, Entry, Manifest, as_file, counted, manifest_of
from greenhouse_gym.scene.scene import Difficulty, Scene

Choice = str | int | Iterable[str | int] | None
"""One value, several, or any."""

SCENES_KEPT = 32
"""How many scenes of a bank are kept in memory: those asked for last, beside those that are in use elsewhere."""


class SceneBank(Sequence[Scene]):
    """A sequence of scenes that are read when they are asked for; those asked for last are kept.

    Attributes:
        path: The bank's folder; of joined banks, that of the first.
        manifest: What its manifest says.
    """

    def __init__(self, path: Path, manifest: Manifest, homes: Mapping[str, SceneBank] | None = None):
        self.path = path
        self.manifest = manifest
        self._homes = homes or {}  # of a part or a union of banks: where each scene is read
        self._entries = {entry.name: entry for entry in manifest.scenes}
        self._alive: weakref.WeakValueDictionary[str, Scene] = weakref.WeakValueDictionary()
        self._scenes: OrderedDict[str, Scene] = OrderedDict()

    @classmethod
    def open(cls, bank: str | Path | SceneBank = "default") -> SceneBank:
        """Open a shipped bank by name or any bank by its folder; a `SceneBank` is given back as it is.

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

    @classmethod
    def join(cls, banks: Iterable[str | Path | SceneBank], name: str = "") -> SceneBank:
        """Several banks as one; nothing is read or written but their manifests.

        Args:
            banks: Names, folders or banks.
            name: Name of the joined bank; by default the names of all banks.

        Raises:
            InvalidValueError: No banks; two scenes of one name; or a row that is in two splits.
        """
        opened = [cls.open(bank) for bank in banks]
        if not opened:
            raise InvalidValueError("expected at least one bank to join")
        named = name or "+".join(bank.manifest.name for bank in opened)
        entries = tuple(entry for bank in opened for entry in bank.manifest.scenes)
        homes = {entry.name: bank for bank in opened for entry in bank.manifest.scenes}
        places = ", ".join(str(bank.path) for bank in opened)
        return cls(opened[0].path, manifest_of(named, f"Joined of {places}", entries, places), homes)

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
        """The scenes that are of all the given kinds, as a bank; splits stay what they are.

        Args:
            split: A split, or several.
            row: Names of rows.
            week: Growth weeks.
            style: Fruit styles.
            source: Where the plants come from.
            protocol: Capture protocols; scenes that tell of none count as the paper's.
            difficulty: Only scenes with at least one target of one of these.

        Raises:
            UnknownNameError: A value that no scene of the bank has; the choices are named.
            InvalidValueError: No scene is of all these kinds.
        """
        asked = {"split": split, "row": row, "week": week, "style": style, "source": source, "protocol": protocol}
        wanted = {
            kind: _several(value) for kind, value in (*asked.items(), ("difficulty", difficulty)) if value is not None
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
        manifest = manifest_of(self.manifest.name, description, chosen, self.path)
        return SceneBank(self.path, manifest, {entry.name: self for entry in chosen})

    def difficulties(self, name: str) -> dict[Difficulty, int]:
        """How many targets of each difficulty a scene has; only in old banks is the scene read for it."""
        entry = self._entry(name)
        return counted(self.scene(name)) if entry.targets is None else entry.targets

    def _kinds(self, entry: Entry) -> dict[str, set[str]]:
        """What a scene is, in the words of `select`."""
        told = {
            "split": entry.split,
            "row": entry.row,
            "week": entry.week,
            "style": entry.style,
            "source": entry.source,
            "protocol": entry.protocol or "paper",
        }
        kinds = {kind: set() if value is None else {str(value)} for kind, value in told.items()}
        return kinds | {"difficulty": {str(name) for name, count in self.difficulties(entry.name).items() if count}}

    def __reduce__(self) -> tuple[Callable[..., SceneBank], tuple[Any, ...]]:
        # a bank travels as its folder, a part or a union of banks as its entries and the folders of those
        return (SceneBank, (self.path, self.manifest, self._homes)) if self._homes else (SceneBank.open, (self.path,))

    @property
    def sha256(self) -> str:
        """The manifest's checksum, and so, through the checksums in it, that of all scenes."""
        return hashlib.sha256(as_file(self.manifest).encode()).hexdigest()

    def names(self, split: str | None = None) -> list[str]:
        """Names of the scenes, all of them or those of one split, in the manifest's order."""
        if split is not None:
            require_choice("split", split, SPLITS)
        return [entry.name for entry in self.manifest.scenes if split in (None, entry.split)]

    def split_of(self, name: str) -> str:
        """The split a scene belongs to."""
        return self._entry(name).split

    def largest_scene(self) -> int | None:
        """Most shapes of a scene, its truth not counted; None where the manifest tells it of no scene."""
        return max((entry.shapes for entry in self.manifest.scenes if entry.shapes is not None), default=None)

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
        if name in self._homes:
            return self._homes[name].scene(name)
        scene = self._alive.get(name)
        if scene is None:
            path = inside(self.path, entry.file, named_in=self.path / MANIFEST)
            content = read_bytes(path, "scene")
            scene = Scene.parse(content, path)
            if hashlib.sha256(content).hexdigest() != entry.sha256:
                raise FileFormatError(path, f"checksum differs from the one in {self.path / MANIFEST}")
            self._alive[name] = scene
        self._scenes[name] = scene
        self._scenes.move_to_end(name)
        if len(self._scenes) > SCENES_KEPT:
            self._scenes.popitem(last=False)
        return scene

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
                shapes=len(scene.obstacles),
                truth=None if scene.truth is None else len(scene.truth.obstacles),
                style=scene.provenance.style,
                source=scene.provenance.source,
                protocol=scene.provenance.protocol,
                targets=counted(scene),
            )
        )
        path = folder / entries[-1].file
        if not _holds(path, content):  # a build has written its scenes already, maybe more than fit in memory
            contents.append((path, content))
    manifest = manifest_of(name, description, tuple(entries), folder)
    for path, content in contents:
        write_atomically(path, content)
    write_atomically(folder / MANIFEST, as_file(manifest))
    return SceneBank(folder, manifest)


def _holds(path: Path, content: str) -> bool:
    try:
        return path.read_bytes() == content.encode()
    except OSError:
        return False


def _several(choice: str | int | Iterable[str | int]) -> set[str]:
    return {str(choice)} if isinstance(choice, str | int) else {str(value) for value in choice}


def _described(wanted: Mapping[str, set[str]]) -> str:
    return "; ".join(f"{kind} {' or '.join(sorted(values))}" for kind, values in wanted.items()) or "everything"
