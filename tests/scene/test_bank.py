from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.scene import Provenance, Scene, SceneBank, Target
from greenhouse_gym.scene import bank as bank_module
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.manifest import MANIFEST


def small(name: str, row: str = "a", **update: Any) -> Scene:
    return Scene(name=name, provenance=Provenance(row=row, week=3), **update)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A bank of three scenes of two rows."""
    scenes = [(small("a-0"), "train"), (small("a-1"), "train"), (small("b-0", row="b"), "test")]
    return write_bank(tmp_path / "bank", scenes, name="small", description="Three.").path


def reopened(folder: Path) -> SceneBank:
    bank_module._opened.cache_clear()
    return SceneBank.open(folder)


def change_manifest(folder: Path, change: Callable[[Any], object]) -> None:
    data = json.loads((folder / MANIFEST).read_text())
    change(data)
    (folder / MANIFEST).write_text(json.dumps(data))


def test_a_bank_is_a_sequence_of_scenes_with_splits(folder: Path) -> None:
    bank = reopened(folder)
    assert len(bank) == 3
    assert [scene.name for scene in bank] == bank.names() == ["a-0", "a-1", "b-0"]
    assert bank[-1].name == "b-0"
    assert [scene.name for scene in bank[:2]] == bank.names("train") == ["a-0", "a-1"]
    assert bank.names("test") == ["b-0"]
    assert bank.names("validation") == []
    assert bank.split_of("b-0") == "test"
    assert bank.scene("a-1").provenance.row == "a"
    assert bank.scene("a-1") is bank.scene("a-1")
    assert (bank.manifest.name, bank.manifest.description) == ("small", "Three.")
    assert [entry.week for entry in bank.manifest.scenes] == [3, 3, 3]
    assert SceneBank.open(bank) is bank
    assert SceneBank.open(str(folder)).names() == bank.names()
    with pytest.raises(IndexError):
        bank[3]


def test_scenes_are_read_when_they_are_asked_for(folder: Path) -> None:
    (folder / "a-1.json").unlink()
    bank = reopened(folder)
    assert bank.scene("a-0").name == "a-0"
    with pytest.raises(FileFormatError, match=r"a-1\.json: cannot be read"):
        bank.scene("a-1")


def test_a_row_in_two_splits_is_refused_and_nothing_written(tmp_path: Path) -> None:
    scenes = [(small("a-0"), "train"), (small("a-1"), "test")]
    with pytest.raises(InvalidValueError, match="row 'a' is in two splits: train, test"):
        write_bank(tmp_path / "bank", scenes, name="leaky")
    assert list(tmp_path.rglob("*")) == []


def test_two_scenes_of_one_name_are_refused_and_nothing_written(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="same name"):
        write_bank(tmp_path / "bank", [(small("a-0"), "train"), (small("a-0"), "train")], name="double")
    assert list(tmp_path.rglob("*")) == []


def test_an_unknown_split_is_refused_and_nothing_written(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"split 'val'.*Choices: train, validation, test"):
        write_bank(tmp_path / "bank", [(small("a-0"), "val")], name="b")
    assert list(tmp_path.rglob("*")) == []


def test_a_changed_scene_does_not_pass_for_the_one_of_the_manifest(folder: Path) -> None:
    small("a-1", row="b").save(folder / "a-1.json")
    bank = reopened(folder)
    with pytest.raises(FileFormatError, match=r"a-1\.json: checksum differs.*manifest\.json"):
        bank.scene("a-1")
    assert bank.scene("a-0").name == "a-0"


def test_unknown_names_list_the_choices(folder: Path) -> None:
    bank = reopened(folder)
    with pytest.raises(UnknownNameError, match=r"scene 'a-2'.*Did you mean.*a-0, a-1, b-0"):
        bank.scene("a-2")
    with pytest.raises(UnknownNameError, match=r"split 'val'.*train, validation, test"):
        bank.names("val")
    with pytest.raises(UnknownNameError, match="a-2"):
        bank.split_of("a-2")
    with pytest.raises(UnknownNameError, match=r"scene bank 'defualt'.*path of a bank's folder"):
        SceneBank.open("defualt")


def test_shipped_names_come_before_folders(folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(bank_module, "data_path", lambda kind: folder.parent)
    monkeypatch.chdir(tmp_path)
    assert SceneBank.open("bank").names() == ["a-0", "a-1", "b-0"]
    with pytest.raises(UnknownNameError, match=r"Choices: bank, "):
        SceneBank.open("bench")


@pytest.mark.parametrize("fail_at", [1, 2, 3, 4])
def test_the_old_manifest_survives_a_failed_write(folder: Path, monkeypatch: pytest.MonkeyPatch, fail_at: int) -> None:
    before = (folder / MANIFEST).read_bytes()
    calls = 0
    write = bank_module.write_atomically

    def failing(path: str | Path, content: str | bytes) -> Path:
        nonlocal calls
        calls += 1
        if calls == fail_at:
            raise OSError("disk full")
        return write(path, content)

    monkeypatch.setattr(bank_module, "write_atomically", failing)
    new = [(small(f"c-{k}", row="c"), "train") for k in range(3)]
    with pytest.raises(OSError, match="disk full"):
        write_bank(folder, new, name="new")
    assert (folder / MANIFEST).read_bytes() == before
    assert [scene.name for scene in reopened(folder)] == ["a-0", "a-1", "b-0"]


def test_scenes_that_are_there_already_are_not_written_again(folder: Path) -> None:
    """Nor held until all are known, so that a build may have more than fit in memory."""
    bank = SceneBank.open(folder)
    files = [folder / entry.file for entry in bank.manifest.scenes]
    before = [path.stat().st_ino for path in files]
    scenes = [(scene, bank.split_of(scene.name)) for scene in bank]
    write_bank(folder, [(small("a-0", row="c"), "train"), *scenes[1:]], name="new")
    after = [path.stat().st_ino for path in files]
    assert [one == other for one, other in zip(before, after, strict=True)] == [False, True, True]


def test_a_bank_written_again_is_the_new_one_at_once(folder: Path) -> None:
    old = SceneBank.open(folder)
    assert len(old) == 3
    write_bank(folder, [(small("a-0", targets=()), "validation")], name="new")
    again = SceneBank.open(folder)
    assert again.manifest.name == "new"
    assert again.split_of("a-0") == "validation"


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda d: d.update(schema_version=2), "schema_version"),
        (lambda d: d.update(author="x"), "author"),
        (lambda d: d.pop("scenes"), "scenes"),
        (lambda d: d["scenes"][0].update(split="val"), r"scenes\.0\.split"),
        (lambda d: d["scenes"][0].update(split="test"), "row 'a' is in two splits"),
        (lambda d: d["scenes"][1].update(name="a-0"), "same name: 'a-0'"),
        (lambda d: d["scenes"][2].pop("sha256"), r"scenes\.2\.sha256"),
        (lambda d: d["scenes"][2].update(colour=1), r"scenes\.2\.colour"),
    ],
)
def test_a_damaged_manifest_names_the_field(folder: Path, change: Callable[[Any], object], problem: str) -> None:
    change_manifest(folder, change)
    with pytest.raises(FileFormatError, match=rf"manifest\.json: not a valid bank manifest: .*{problem}"):
        reopened(folder)


def test_a_folder_without_a_manifest_or_with_half_of_one(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"manifest\.json: cannot be read"):
        reopened(tmp_path)
    content = (folder / MANIFEST).read_bytes()
    (folder / MANIFEST).write_bytes(content[: len(content) // 2])
    with pytest.raises(FileFormatError, match="not a valid bank manifest"):
        reopened(folder)


# -- parts and unions of banks ----------------------------------------------------------------------------------------


def told(name: str, row: str, week: int, difficulty: str = "easy", **facts: str) -> Scene:
    tomatoes = (Tomato(Sphere([0.5, 0.0, 1.0], 0.03), truss=0),)
    targets = (Target(tomato=0, difficulty=difficulty),)
    provenance = Provenance(row=row, week=week, **facts)
    return Scene(name=name, tomatoes=tomatoes, targets=targets, provenance=provenance)


@pytest.fixture
def varied(tmp_path: Path) -> SceneBank:
    scenes = [
        (told("a-0", "a", 1, style="cherry", source="own"), "train"),
        (told("a-1", "a", 4, "hard", style="cherry", source="own", protocol="upright-back"), "train"),
        (told("b-0", "b", 1, style="cluster", source="helios"), "validation"),
        (told("c-0", "c", 2, "hard", style="cluster", source="helios"), "test"),
    ]
    return write_bank(tmp_path / "varied", scenes, name="varied")


@pytest.mark.parametrize(
    ("asked", "names"),
    [
        ({}, ["a-0", "a-1", "b-0", "c-0"]),
        ({"split": ("train", "test")}, ["a-0", "a-1", "c-0"]),
        ({"row": "a", "week": 4}, ["a-1"]),
        ({"week": [1, 2]}, ["a-0", "b-0", "c-0"]),
        ({"style": "cherry"}, ["a-0", "a-1"]),
        ({"source": "helios", "difficulty": "hard"}, ["c-0"]),
        ({"protocol": "paper"}, ["a-0", "b-0", "c-0"]),
        ({"difficulty": ("easy", "hard")}, ["a-0", "a-1", "b-0", "c-0"]),
    ],
)
def test_scenes_are_selected_by_what_they_are(varied: SceneBank, asked: dict[str, Any], names: list[str]) -> None:
    chosen = reopened(varied.path).select(**asked)
    assert chosen.names() == names
    assert [scene.name for scene in chosen] == names
    assert all(chosen.split_of(name) == varied.split_of(name) for name in names)


def test_selecting_what_there_is_not(varied: SceneBank) -> None:
    with pytest.raises(UnknownNameError, match=r"unknown style 'chery'\. Did you mean 'cherry'"):
        varied.select(style="chery")
    with pytest.raises(InvalidValueError, match="no scene with split test; source own"):
        varied.select(split="test", source="own")


def test_selecting_reads_no_scenes_unless_the_manifest_is_old(varied: SceneBank) -> None:
    assert all(entry.targets == {"easy": 0, "medium": 0, "unreachable": 0} | entry.targets
               for entry in varied.manifest.scenes)  # fmt: skip
    change_manifest(varied.path, lambda data: [scene.pop("targets") for scene in data["scenes"]])
    assert reopened(varied.path).select(difficulty="hard").names() == ["a-1", "c-0"]
    for file in varied.path.glob("*-*.json"):
        file.unlink()
    assert varied.select(difficulty="hard").names() == ["a-1", "c-0"]


def test_banks_join(varied: SceneBank, folder: Path, tmp_path: Path) -> None:
    other = write_bank(tmp_path / "other", [(told("d-0", "d", 3), "test")], name="other")
    both = SceneBank.join([varied.path, other])
    assert both.names() == [*varied.names(), "d-0"]
    assert both.names("test") == ["c-0", "d-0"]
    assert [scene.name for scene in both] == both.names()
    assert both.manifest.name == "varied+other"
    assert both.select(week=3).names() == ["d-0"]
    assert SceneBank.open(both) is both
    assert len({both.sha256, varied.sha256, other.sha256, varied.select(week=1).sha256}) == 4
    with pytest.raises(InvalidValueError, match="at least one bank"):
        SceneBank.join([])


def test_rows_stay_in_their_split_across_joined_banks(varied: SceneBank, tmp_path: Path) -> None:
    leak = write_bank(tmp_path / "leak", [(told("a-9", "a", 9), "test")], name="leak")
    with pytest.raises(InvalidValueError, match="row 'a' is in two splits: train, test"):
        SceneBank.join([varied, leak])
    twice = write_bank(tmp_path / "twice", [(told("a-0", "z", 9), "test")], name="twice")
    with pytest.raises(InvalidValueError, match="two scenes have the same name"):
        SceneBank.join([varied, twice])


def test_a_newer_schema_is_said_to_be_one(varied: SceneBank) -> None:
    change_manifest(varied.path, lambda data: data.update(schema_version=2))
    with pytest.raises(FileFormatError, match=r"written by a newer version.*schema 2.*update"):
        reopened(varied.path)


def test_a_checksum_is_that_of_the_manifest_file(varied: SceneBank) -> None:
    assert varied.sha256 == hashlib.sha256((varied.path / MANIFEST).read_bytes()).hexdigest()
