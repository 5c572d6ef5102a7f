from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import make_scene
from scipy.spatial import cKDTree

from greenhouse_gym.build import grown, shipped
from greenhouse_gym.build.grown import KINDS, RowRecording, build_part, build_training_bank, training_recordings
from greenhouse_gym.capture import PROTOCOLS
from greenhouse_gym.crops import CULTIVARS, STYLES
from greenhouse_gym.errors import InvalidValueError, NoPlacementError, ReconstructionError
from greenhouse_gym.planning import planner_run
from greenhouse_gym.planning.certify import certify_target
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Provenance, Scene, SceneBank, compile_scene
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.manifest import SPLITS
from greenhouse_gym.scene.truth import start_is_collision_free


def test_the_recipe_is_as_large_and_varied_as_it_says() -> None:
    recordings = list(shipped.row_recordings())
    rows = {recording.row: recording for recording in recordings}
    assert len({recording.name for recording in recordings}) == len(recordings) == 62
    assert len(rows) == 51
    assert Counter(recording.split for recording in rows.values()) == {"train": 34, "validation": 8, "test": 9}
    assert all(rows[recording.row].split == recording.split for recording in recordings)
    assert {recording.week for recording in recordings} == set(range(12))
    assert {(recording.source, recording.style) for recording in recordings} == {
        (a, b) for a in ("own", "helios") for b in STYLES
    }
    assert {recording.protocol for recording in recordings} == {"paper", "upright-back"} <= set(PROTOCOLS)
    for recording in recordings:
        assert recording.cultivar in (STYLES if recording.source == "own" else CULTIVARS)
        assert recording.seed >= 2000


@pytest.mark.parametrize("split", SPLITS)
def test_every_split_has_both_sources_and_all_styles(split: str) -> None:
    mine = [recording for recording in shipped.row_recordings() if recording.split == split]
    assert {recording.source for recording in mine} == {"own", "helios"}
    assert {recording.style for recording in mine} == set(STYLES)


def made_up_part(recording: RowRecording, parts: Path, description: str) -> Path:
    provenance = Provenance(
        row=recording.row, week=recording.week, style=recording.style, source=recording.source, recording=recording.name
    )
    scenes = [
        make_scene(k).model_copy(update={"name": f"{recording.name}-{k:02d}", "provenance": provenance})
        for k in range(4)
    ]
    return write_bank(parts / recording.name, [(scene, recording.split) for scene in scenes], recording.name).path


def test_parts_are_joined_in_order_and_a_part_of_them_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recordings = list(shipped.row_recordings())
    for recording in (recordings[9], recordings[0], recordings[1], recordings[4]):
        made_up_part(recording, tmp_path, "")
    default, mini = shipped.join_parts(tmp_path, tmp_path / "out")
    assert default.names() == [f"{recordings[k].name}-{i:02d}" for k in (0, 1, 4, 9) for i in range(4)]
    assert mini.names() == [name for name in shipped.MINI_SCENES if name in default.names()]
    assert len(mini) == 3
    monkeypatch.setattr(shipped, "build_part", made_up_part)
    with ThreadPoolExecutor(2) as executor:
        default, mini = shipped.build_shipped_banks(tmp_path / "out", tmp_path, executor)
    assert len(default) == 4 * len(recordings)
    assert mini.names() == list(shipped.MINI_SCENES)
    assert len(mini) == len(KINDS)
    assert {entry.style for entry in mini.manifest.scenes} == set(STYLES)
    assert {entry.source for entry in mini.manifest.scenes} == {"own", "helios"}
    assert all(mini.names(split) for split in SPLITS)


def test_training_rows_are_new_and_of_all_kinds() -> None:
    rows = list(training_recordings(16))
    assert {(row.source, row.cultivar, row.style) for row in rows} == set(KINDS)
    assert {row.protocol for row in rows} == {"paper", "upright-back"}
    assert {row.split for row in rows} == {"train"}
    assert not {row.seed for row in rows} & {row.seed for row in shipped.row_recordings()}
    helios = list(training_recordings(4, 10_008, "helios"))
    assert [row.seed for row in helios] == [10_008, 10_009, 10_010, 10_011]
    assert {row.source for row in helios} == {"helios"}


@pytest.mark.parametrize(
    ("values", "told"),
    [((0,), "count"), ((2, 2004), "10000 or more: .* got 2004"), ((2, 10_000, "real"), "helios, own, got 'real'")],
)
def test_training_rows_that_cannot_be_grown_are_refused(values: tuple[Any, ...], told: str) -> None:
    with pytest.raises(InvalidValueError, match=told):
        list(training_recordings(*values))


def test_a_training_bank_resumes_and_is_equal_on_any_executor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = list(training_recordings(4))
    built: list[str] = []

    def part(recording: RowRecording, parts: Path, description: str) -> Path:
        if not (parts / recording.name).exists():
            made_up_part(recording, parts, description)
            built.append(recording.name)
        if built == [row.name for row in rows[:2]]:
            built.append("interrupted")
            raise KeyboardInterrupt
        return parts / recording.name

    monkeypatch.setattr(grown, "build_part", part)
    with pytest.raises(KeyboardInterrupt):
        build_training_bank(tmp_path / "bank", rows)
    counts: list[int] = []
    bank = build_training_bank(tmp_path / "bank", rows, on_progress=counts.append)
    assert built == [rows[0].name, rows[1].name, "interrupted", rows[2].name, rows[3].name]
    assert counts == [1, 2, 3, 4]
    monkeypatch.setattr(grown, "build_part", made_up_part)
    with ThreadPoolExecutor(2) as executor:
        other = build_training_bank(tmp_path / "other" / "bank", rows, executor)
    assert other.manifest == bank.manifest
    assert len(bank.names("train")) == len(bank) == 16
    assert sorted(path.suffix for path in (tmp_path / "bank").iterdir() if path.is_dir()) == []

    def rebuilt(recording: RowRecording, parts: Path, description: str) -> Path:
        raise AssertionError(f"{recording.name} was built again")

    monkeypatch.setattr(grown, "build_part", rebuilt)
    assert build_training_bank(tmp_path / "bank", rows).manifest == bank.manifest, "a finished bank stays"
    with pytest.raises(InvalidValueError, match=r"holds another bank .*4 recordings.*new folder for .*3 recordings"):
        build_training_bank(tmp_path / "bank", rows[:3])
    assert SceneBank.open(tmp_path / "bank").manifest == bank.manifest


def test_rows_that_cannot_be_used_are_left_out_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = list(training_recordings(3))
    unusable = {rows[0].name: NoPlacementError("no room"), rows[2].name: ReconstructionError("too dark")}

    def part(recording: RowRecording, parts: Path, description: str) -> Path:
        if error := unusable.get(recording.name):
            raise error
        return made_up_part(recording, parts, description)

    monkeypatch.setattr(grown, "build_part", part)
    counts: list[int] = []
    bank = build_training_bank(tmp_path / "bank", rows, on_progress=counts.append)
    assert {entry.row for entry in bank.manifest.scenes} == {rows[1].row}
    assert counts == [1, 2, 3]
    told = capsys.readouterr().err
    assert f"{rows[0].name} is left out: no room" in told
    assert f"{rows[2].name} is left out: too dark" in told
    with pytest.raises(InvalidValueError, match="none of the 1 rows"):
        build_training_bank(tmp_path / "none", rows[2:])
    with pytest.raises(InvalidValueError, match="got none"):
        build_training_bank(tmp_path / "empty", [])
    assert not (tmp_path / "empty").exists()


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("count", [8, pytest.param(100, marks=pytest.mark.slow)])
def test_ratings_of_shipped_targets_are_found_again(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some were once unreachable only because the planner had died while they were rated."""
    monkeypatch.setattr(planner_run, "shared_worker", lambda: pytest.fail("OMPL was asked"))
    bank = SceneBank.open("default")
    pool = [(name, target) for name in bank.names() for target in bank.scene(name).targets if target.goals]
    agreeing = 0
    for name, target in (pool[k] for k in np.random.default_rng(count).permutation(len(pool))[:count]):
        found = certify_target(compile_scene(bank.scene(name), get_robot(target.robot)), target.tomato)
        assert (found.witness is None) == (target.witness is None), name
        agreeing += found == target.model_copy(update={"unknown": None, "brush": None})
    assert agreeing >= 0.98 * count, "another processor may round otherwise"


def test_every_scene_of_mini_has_targets_within_reach_and_both_ratings() -> None:
    for scene in SceneBank.open("mini"):
        assert any(target.witness for target in scene.targets), scene.name
        assert all(target.brush is not None for target in scene.targets), scene.name


@pytest.mark.slow
def test_shipped_arms_begin_in_no_true_plants() -> None:
    assert not [scene.name for scene in SceneBank.open("default") if not start_is_collision_free(scene, "ur5e")]


@pytest.fixture(scope="module")
def built_twice(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Scene, Scene]]:
    """Scenes of a recording as built now and as shipped."""
    recording = next(shipped.row_recordings())
    made = SceneBank.open(build_part(recording, tmp_path_factory.mktemp("again"), shipped.DESCRIPTION))
    bank = SceneBank.open("default")
    assert made.names() == [name for name in bank.names() if name.startswith(f"{recording.name}-")]
    return [(made.scene(name), bank.scene(name)) for name in made.names()]


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.xfail(reason="on another kind of processor than the bank was built on, sums round differently in places")
def test_a_shipped_recording_is_built_again(built_twice: list[tuple[Scene, Scene]]) -> None:
    for made, expected in built_twice:
        assert made.model_dump_json() == expected.model_dump_json(), made.name


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_shipped_recording_is_built_again_on_any_processor(built_twice: list[tuple[Scene, Scene]]) -> None:
    # fruit move by tenths of a millimetre, stems and clutter are divided elsewhere, one shape of twenty comes or goes
    t = np.linspace(0, 1, 101)[:, None, None]
    for scenes in built_twice:
        assert scenes[0].placement.model_dump() == scenes[1].placement.model_dump(), scenes[0].name
        axes = [scene.arrays.starts + t * (scene.arrays.ends - scene.arrays.starts) for scene in scenes]
        for k, tolerance in enumerate((1e-3, 3e-3, 0.05)):
            first, last = (np.array([sum(scene.counts[:m]) for scene in scenes]) for m in (k, k + 1))
            found, expected = (points[:, a:b] for points, a, b in zip(axes, first, last, strict=True))
            assert abs(found.shape[1] - expected.shape[1]) <= 1 + 0.05 * expected.shape[1], (scenes[0].name, k)
            gaps = cKDTree(expected.reshape(-1, 3)).query(found.reshape(-1, 3))[0]
            assert np.mean(gaps < tolerance) > 0.95, (scenes[0].name, k, np.quantile(gaps, [0.5, 0.9, 0.95]))
