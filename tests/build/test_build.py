from __future__ import annotations

import os
import signal
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from parallel_helpers import Elsewhere
from row_helpers import HALF, half_cloud, half_recording

from greenhouse_gym.build import bank_builder as build
from greenhouse_gym.build import build_bank, default_splits
from greenhouse_gym.build import scenes as cutting
from greenhouse_gym.build.scenes import BuildSettings, cut_scenes, level, placement_positions
from greenhouse_gym.capture import Recording, RgbdFrame, Station, write_recording
from greenhouse_gym.common.files import exclusive
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.errors import FileWriteError, InvalidValueError, NoPlacementError, ReconstructionError
from greenhouse_gym.geometry import Box, Sphere, distance_to_shapes, pose, rotation_about, rotation_angle
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, RowReport
from greenhouse_gym.scene import Provenance, Scene, SceneBank, Target
from greenhouse_gym.scene.manifest import MANIFEST
from greenhouse_gym.scene.workspace import in_frame, middle
from greenhouse_gym.shapes import RowShapes, ShapeSettings, extract_shapes


def recording(name: str = "row", stations: int = 20, shade: int = 0) -> Recording:
    """A recording that lies on no disk; its images tell it from others of its name."""
    return Recording(name, HALF, stations, partial(of_one_shade, shade))


def of_one_shade(shade: int, i: int) -> Station:
    intrinsics = HALF.cameras["middle"].intrinsics
    color = np.full((intrinsics.height, intrinsics.width, 3), shade, np.uint8)
    frame = RgbdFrame(color, np.zeros(color.shape[:2], np.float32), intrinsics)
    return Station(dict.fromkeys(HALF.cameras, frame))


def made_up_row(stations: int, tilt: float = 0.0, step: float = 0.1) -> RowCloud:
    """A walk of even steps; each station tilted to the other side of the one before."""
    poses = np.array([pose(rotation_about([1, 0, 0], tilt * (-1) ** k), [0.0, step * k, 0.0]) for k in range(stations)])
    none = np.zeros((0, 3))
    return RowCloud(none, none, none, np.zeros(0, np.int32), np.ones(stations, bool), poses, RowReport(()))


def made_up_shapes(length: float = 2.0, boxes: int = 300) -> RowShapes:
    """Stems every half metre, a tomato on each, and many small boxes."""
    random = np.random.default_rng(0)
    places = np.arange(0.25, length, 0.5)
    return RowShapes(
        tuple(Tomato(Sphere([0.4, y, 1.0 + 1e-7], 0.0300004), truss=k, ripeness=0.5) for k, y in enumerate(places)),
        tuple(Stem([0.52, y, 0.5], [0.5, y + 0.01, 2.1], 0.006, kind="main") for y in places),
        tuple(
            Box(random.uniform([0.3, 0, 0.6], [0.8, length, 1.9]), random.uniform(0.003, 0.02, 3),
                rotation_about(random.normal(size=3), random.uniform(0, 3)))
            for _ in range(boxes)
        ),
    )  # fmt: skip


# -- parts ------------------------------------------------------------------------------------------------------------


def test_splits_of_rows() -> None:
    assert default_splits(1) == ["train"]
    assert default_splits(2) == ["train", "validation"]
    assert default_splits(3) == ["train", "train", "validation"]
    assert default_splits(6) == ["train"] * 4 + ["validation", "test"]
    for rows in range(1, 40):
        splits = default_splits(rows)
        assert len(splits) == rows
        assert splits.count("train") >= max(1, rows // 2)
        assert 0 <= splits.count("validation") - splits.count("test") <= 1


@pytest.mark.parametrize(
    ("along", "expected"),
    [
        (0.1 * np.arange(20), [0.45, 0.95, 1.45]),
        (0.1 * np.arange(5), [0.2]),
        (np.zeros(1), [0.0]),
        (0.1 * np.arange(25), [0.45, 0.95, 1.45, 1.95]),
        (0.05 * np.arange(40), [0.475, 0.975, 1.475]),
        (-0.1 * np.arange(20), [-0.45, -0.95, -1.45]),
        (np.array([*0.1 * np.arange(20), *0.1 * np.arange(20)]), [0.45, 0.95, 1.45]),
        (3.0 + 0.1 * np.arange(20), [3.45, 3.95, 4.45]),
    ],
    ids=["ten cm", "short", "one", "long", "five cm", "backward", "two passes", "elsewhere"],
)
def test_stands_are_spread_evenly_over_where_the_rig_went(along: np.ndarray, expected: list[float]) -> None:
    np.testing.assert_allclose(placement_positions(along, BuildSettings()), expected)


@pytest.mark.parametrize("step", [0.05, 0.1])
def test_scenes_have_tomatoes_wherever_the_stations_are(step: float) -> None:
    row = made_up_row(round(2.0 / step), step=step)
    scenes = cut_scenes(row, made_up_shapes(), recording(stations=len(row.registered)), None, BuildSettings())
    assert len(scenes) == 3
    assert all(len(scene.tomatoes) >= 2 for scene in scenes)


def test_leveling_takes_the_mean_of_the_stations() -> None:
    row = made_up_row(10)
    tilted = pose(rotation_about([1.0, 2.0, 0.0], 0.03))
    first_tilted = replace(row, world_from_station=np.array([tilted @ p for p in row.world_from_station]))
    np.testing.assert_allclose(level(first_tilted), np.linalg.inv(tilted), atol=1e-9)
    np.testing.assert_allclose(level(row), np.eye(4), atol=1e-12)
    assert rotation_angle(level(made_up_row(10, tilt=0.02))[:3, :3]) < 1e-9
    gone = first_tilted.world_from_station.copy()
    gone[4] = np.nan
    partial = replace(first_tilted, world_from_station=gone, registered=np.arange(10) != 4)
    np.testing.assert_allclose(level(partial), np.linalg.inv(tilted), atol=1e-9)


def scenes_of(shapes: RowShapes, settings: BuildSettings | None = None) -> list[Scene]:
    return cut_scenes(made_up_row(20), shapes, recording(), 2, settings or BuildSettings())


def test_scenes_stand_before_the_stem_line() -> None:
    scenes = scenes_of(made_up_shapes())
    assert [scene.name for scene in scenes] == ["row-00", "row-01", "row-02"]
    for scene, along in zip(scenes, (4.5, 9.5, 14.5), strict=True):
        stems = [stem for stem in scene.stems if stem.kind == "main"]
        assert np.median([(s.start[0] + s.end[0]) / 2 for s in stems]) == pytest.approx(0.60, abs=1e-4)
        assert scene.placement.shoulder_height == 1.1
        assert (scene.provenance.row, scene.provenance.week) == ("row", 2)
        assert abs(scene.provenance.station - along) == pytest.approx(0.5)
        assert scene.targets == ()
        near = sorted(tomato.center[1] for tomato in scene.tomatoes)
        np.testing.assert_allclose(near, np.arange(len(near)) * 0.5 + near[0], atol=1e-4)
        assert all(abs(y) < 0.8 for y in near)


@pytest.mark.parametrize("primitives", [300, 60])
def test_scenes_keep_to_the_number_of_primitives_and_the_arms_reach(primitives: int) -> None:
    settings = BuildSettings(max_shapes=primitives)
    shapes = made_up_shapes(boxes=900)
    fuller = scenes_of(shapes, BuildSettings(max_shapes=100_000))
    for scene, whole in zip(scenes_of(shapes, settings), fuller, strict=True):
        assert len(scene.obstacles) <= primitives < len(whole.obstacles)
        distance = distance_to_shapes(np.array([[0.0, 0.0, 1.1]]), scene.obstacles)[0]
        assert distance.max() < settings.reach
        everything = np.sort(distance_to_shapes(np.array([[0.0, 0.0, 1.1]]), whole.obstacles)[0])
        np.testing.assert_allclose(np.sort(distance), everything[: len(distance)])  # the nearest are kept


def test_of_too_many_shapes_pedicels_go_first() -> None:
    shapes = made_up_shapes(boxes=100)
    pedicels = tuple(Stem([0.4, y, 1.0], [0.42, y, 1.02], 0.001, kind="pedicel") for y in np.linspace(0.9, 1.1, 50))
    held = replace(shapes, stems=(*shapes.stems, *pedicels))
    plain = scenes_of(shapes)[1]
    for most, left in ((10**6, 50), (len(plain.obstacles) + 7, 7), (len(plain.obstacles), 0)):
        scene = scenes_of(held, BuildSettings(max_shapes=most))[1]
        assert sum(stem.kind == "pedicel" for stem in scene.stems) == left
        assert len(scene.clutter) == len(plain.clutter)


def rounded(numbers: np.ndarray | float) -> bool:
    return bool(np.allclose(np.asarray(numbers), np.round(numbers, 5), rtol=0, atol=1e-12))


def test_shapes_are_rounded_to_a_hundredth_of_a_millimetre() -> None:
    for scene in cut_scenes(made_up_row(20, tilt=0.01), made_up_shapes(), recording(), None, BuildSettings()):
        for shape in scene.obstacles:
            if isinstance(shape, Box):
                assert rounded(shape.center)
                assert rounded(shape.half_extents)
            elif isinstance(shape, Stem):
                assert rounded(shape.start)
                assert rounded(shape.end)
                assert rounded(shape.radius)
            else:
                assert rounded(shape.center)
                assert rounded(shape.radius)


def test_without_main_stems_the_nominal_distance_counts() -> None:
    shapes = replace(made_up_shapes(), stems=())
    scene = scenes_of(shapes)[0]
    assert {round(float(t.center[0]), 5) for t in scene.tomatoes} == {0.5}  # 0.4 from the camera's line, 0.6 - 0.5 more


def test_an_empty_row_gives_empty_scenes() -> None:
    assert [scene.obstacles for scene in scenes_of(RowShapes())] == [(), (), ()]


def true_row() -> PlantRow:
    """The made-up shapes as they truly are, in a world of their own."""
    shapes = made_up_shapes()
    return PlantRow(shapes.tomatoes, shapes.stems, shapes.clutter, 2.0, 0)


def known_recording(world_from_row: np.ndarray | None) -> Recording:
    """A recording that knows its row, and where its stations stood but for the first, which it has half a metre off."""

    return replace(recording(), load=partial(station_without_images, world_from_row), truth=true_row())


def station_without_images(world_from_row: np.ndarray | None, i: int) -> Station:
    known = None if world_from_row is None else world_from_row @ made_up_row(20).world_from_station[i]
    return Station({}, known if i or known is None else known @ pose(translation=[0.5, 0.0, 0.0]))


def test_truth_comes_by_the_pose_of_the_station_nearest_to_the_arm() -> None:
    there = pose(rotation_about([0.2, 0.1, 1.0], 0.7), [3.0, -2.0, 0.1])
    seen = made_up_shapes()
    moved_row = PlantRow(
        *(tuple(in_frame(s, there) for s in part) for part in (seen.tomatoes, seen.stems, seen.clutter)), 2.0, 0
    )
    known = replace(known_recording(there), truth=moved_row)
    for scene, plain in zip(cut_scenes(made_up_row(20), seen, known, 2, BuildSettings()), scenes_of(seen), strict=True):
        assert scene.tomatoes[0].center.tolist() == plain.tomatoes[0].center.tolist()
        assert scene.truth is not None
        # what was found is exactly what is there, in this row; truth is not cut to the scene's width or number
        for found in scene.obstacles:
            gap = distance_to_shapes(middle(found)[None], scene.truth.obstacles).min()
            assert gap == pytest.approx(distance_to_shapes(middle(found)[None], [found])[0, 0], abs=3e-4)
        assert len(scene.truth.obstacles) >= len(scene.obstacles)
        shoulder = np.array([[0.0, 0.0, 1.1]])
        assert distance_to_shapes(shoulder, scene.truth.obstacles).max() < BuildSettings().reach + 1e-3


def test_truth_without_a_pose_is_named() -> None:
    with pytest.raises(InvalidValueError, match=r"row.*station 5.*truth\.npz"):
        cut_scenes(made_up_row(20), made_up_shapes(), known_recording(None), None, BuildSettings())
    assert all(scene.truth is None for scene in scenes_of(made_up_shapes()))


# -- whole builds -----------------------------------------------------------------------------------------------------


class Calls:
    """Cheap stand-ins for the three long stages that count how often they are called."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.reconstructed: list[str] = []
        self.fail_at: str | None = None
        self.certified: list[str] = []
        monkeypatch.setattr(build, "reconstruct_row", self.reconstruct)
        monkeypatch.setattr(build, "extract_shapes", lambda *_: made_up_shapes(boxes=20))
        monkeypatch.setattr(build, "certify_targets", self.certify)

    def reconstruct(self, recording: Recording, settings: ReconstructionSettings, folder: Path) -> RowCloud:
        if recording.name == self.fail_at:
            raise ReconstructionError("stopped")
        self.reconstructed.append(recording.name)
        return made_up_row(len(recording))

    def certify(self, scene: Scene, robot: str, *, max_targets: int | None, min_radius: float) -> tuple[Target, ...]:
        if scene.name == self.fail_at:
            raise KeyboardInterrupt
        self.certified.append(scene.name)
        return tuple(Target(tomato=i, difficulty="easy", robot=robot) for i in range(len(scene.tomatoes))[:max_targets])


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    return Calls(monkeypatch)


ROWS = [recording("a"), recording("b"), recording("a-1")]


def built(out: Path, rows: list[Recording] = ROWS, **options: Any) -> SceneBank:
    return build_bank(rows, out, "made-up", on_progress=lambda text: None, **options)


def test_a_bank_of_three_rows(calls: Calls, tmp_path: Path) -> None:
    bank = built(tmp_path, weeks=[0, 1, 2], description="Made up.")
    assert calls.reconstructed == ["a", "b", "a-1"]
    assert len(bank) == 9
    assert bank.names("train") == ["a-00", "a-01", "a-02", "b-00", "b-01", "b-02"]
    assert bank.names("validation") == ["a-1-00", "a-1-01", "a-1-02"]
    assert [bank.scene(f"{row}-00").provenance.week for row in ("a", "b", "a-1")] == [0, 1, 2]
    assert all(len(scene.targets) == len(scene.tomatoes) > 0 for scene in bank)
    assert SceneBank.open(tmp_path).manifest.description == "Made up."


def test_nobody_puts_an_arm_up_in_the_plants(calls: Calls, tmp_path: Path) -> None:
    row, said = known_recording(np.eye(4)), list[str]()
    leaf = Box([-0.09, 0.95, 1.5], [0.05, 0.05, 0.001], np.eye(3))  # at the second stand, and not in the scan
    assert row.truth is not None
    one, all_stands = (
        replace(row, truth=replace(row.truth, clutter=leaves))
        for leaves in ((leaf,), tuple(replace(leaf, center=[-0.09, y, 1.5]) for y in (0.45, 0.95, 1.45)))
    )
    bank = build_bank([one], tmp_path / "one", "made-up", on_progress=said.append)
    assert bank.names() == ["row-00", "row-02"]
    assert calls.certified == bank.names()
    assert any("1 of 3 placements left out" in line for line in said)
    with pytest.raises(NoPlacementError, match=r"'row': at all 3 placements.*stem_distance, now 0\.6 m"):
        built(tmp_path / "all", [all_stands])


def test_recordings_of_one_row_in_several_weeks(calls: Calls, tmp_path: Path) -> None:
    known = [Provenance(row=row, style="cherry", source="own") for row in ("x", "x", "y")]
    options: dict[str, Any] = {"weeks": [2, 5, 2], "known": known, "settings": BuildSettings(max_targets=2)}
    bank = built(tmp_path, splits=["train", "train", "test"], **options)
    assert [(entry.row, entry.week, entry.split) for entry in bank.manifest.scenes[::3]] == [
        ("x", 2, "train"), ("x", 5, "train"), ("y", 2, "test"),
    ]  # fmt: skip
    assert all((entry.style, entry.source) == ("cherry", "own") for entry in bank.manifest.scenes)
    assert all(len(scene.targets) == 2 for scene in bank)
    built(tmp_path, splits=["train", "train", "test"], **options)
    assert calls.reconstructed == ["a", "b", "a-1"]
    with pytest.raises(InvalidValueError, match="row 'x' is in two splits"):
        built(tmp_path / "leak", splits=["train", "test", "test"], **options)


def test_a_finished_build_is_not_repeated_and_gives_the_same_files(calls: Calls, tmp_path: Path) -> None:
    built(tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    calls.reconstructed.clear()
    built(tmp_path)
    assert calls.reconstructed == []
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_an_interrupted_build_goes_on_where_it_stopped(calls: Calls, tmp_path: Path) -> None:
    calls.fail_at = "b"
    with pytest.raises(ReconstructionError):
        built(tmp_path)
    assert not (tmp_path / MANIFEST).exists()
    calls.fail_at = None
    assert len(built(tmp_path)) == 9
    assert calls.reconstructed == ["a", "b", "a-1"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_build_killed_at_any_file_goes_on_to_the_same_bank(calls: Calls, tmp_path: Path) -> None:
    """Killed outright before or after each of its files is in place, then built again: same files, none besides."""
    rows = [recording("a")]
    built(tmp_path / "whole", rows)
    expected = files_of(tmp_path / "whole")
    put = Path.replace
    for moment in range(1000):
        out, left = tmp_path / str(moment), [moment // 2]

        def replace_or_die(path: Path, target: Path, left: list[int] = left, late: bool = bool(moment % 2)) -> Path:
            left[0] -= 1
            if left[0] >= 0:
                return put(path, target)
            if late:
                put(path, target)
            os.kill(os.getpid(), signal.SIGKILL)
            raise AssertionError

        child = os.fork()
        if child == 0:
            Path.replace = replace_or_die  # type: ignore[method-assign, assignment]
            built(out, rows)
            os._exit(0)
        if os.waitpid(child, 0)[1] == 0:
            break
        built(out, rows)
        assert files_of(out) == expected
    assert moment == 2 * (1 + 3 + 1)  # the scenes without targets, those with, the manifest


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_row_of_which_a_scene_is_missing_or_damaged_is_built_anew(calls: Calls, tmp_path: Path) -> None:
    built(tmp_path)
    calls.reconstructed.clear()
    (tmp_path / "a-01.json").unlink()
    content = (tmp_path / "b-02.json").read_bytes()
    (tmp_path / "b-02.json").write_bytes(content[:100])
    built(tmp_path)
    assert calls.reconstructed == ["a", "b"]
    assert (tmp_path / "b-02.json").read_bytes() == content


@pytest.mark.parametrize(
    "settings",
    [
        BuildSettings(width=1.5),
        BuildSettings(reconstruction=ReconstructionSettings(voxel=0.003)),
        BuildSettings(reconstruction=ReconstructionSettings(step_range=(0.02, 0.15))),
        BuildSettings(shapes=ShapeSettings(radii=(0.02, 0.04))),
    ],
)
def test_changed_settings_rebuild_every_row(calls: Calls, tmp_path: Path, settings: BuildSettings) -> None:
    built(tmp_path)
    calls.reconstructed.clear()
    built(tmp_path, settings=settings)
    assert calls.reconstructed == ["a", "b", "a-1"]
    built(tmp_path, settings=settings)
    assert calls.reconstructed == ["a", "b", "a-1"]


def test_scenes_without_the_truth_that_a_recording_knows_are_built_anew(calls: Calls, tmp_path: Path) -> None:
    for row in (recording(), known_recording(pose()), known_recording(pose())):
        bank = built(tmp_path, [row])
    assert calls.reconstructed == ["row"] * 2
    sizes = [len(scene.truth.obstacles) for scene in bank if scene.truth is not None]
    assert len(sizes) == 3
    assert bank.largest_truth() == SceneBank.open(tmp_path).largest_truth() == max(sizes)


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_rows_built_elsewhere_give_the_same_files(calls: Calls, tmp_path: Path) -> None:
    rows = [*ROWS, known_recording(pose())]
    elsewhere = Elsewhere()
    for out, executor in (("here", None), ("there", elsewhere)):
        built(tmp_path / out, rows, weeks=[0, 1, 2, None], executor=executor)
    assert files_in(tmp_path / "there") == files_in(tmp_path / "here")
    assert Counter(elsewhere.works) == {"_origin": 4, "_cut": 4, "_certified": 12}
    built(tmp_path / "there", rows, weeks=[0, 1, 2, None], executor=elsewhere)
    assert len(elsewhere.works) == 20 + 4


def test_a_build_elsewhere_goes_on_with_the_scene_at_which_it_stopped(calls: Calls, tmp_path: Path) -> None:
    calls.fail_at = "b-01"
    with pytest.raises(KeyboardInterrupt):
        built(tmp_path / "there", executor=Elsewhere())
    assert calls.reconstructed == ["a", "b", "a-1"]
    kept = {path.name for path in (tmp_path / "there").glob("*.json")}
    assert kept
    calls.fail_at = None
    calls.certified.clear()
    built(tmp_path / "there", executor=Elsewhere())
    assert len(calls.reconstructed) == 3
    assert len(calls.certified) == 9 - len(kept)
    built(tmp_path / "here")
    assert files_in(tmp_path / "there") == files_in(tmp_path / "here")


def test_a_recording_that_cannot_travel_is_named_before_any_work(calls: Calls, tmp_path: Path) -> None:
    row = replace(recording("a"), load=lambda i: of_one_shade(0, i))
    with pytest.raises(InvalidValueError, match="recording 'a' cannot be pickled"):
        built(tmp_path, [row], executor=Elsewhere())
    assert calls.reconstructed == []
    assert len(built(tmp_path, [row])) == 3


def test_another_version_rebuilds(calls: Calls, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built(tmp_path)
    monkeypatch.setattr(cutting, "version", lambda name: "99.0")
    built(tmp_path)
    assert calls.reconstructed == ["a", "b", "a-1"] * 2


def test_another_week_rebuilds(calls: Calls, tmp_path: Path) -> None:
    for week in (1, 1, None, 2):
        build_bank([recording("a")], tmp_path, "b", weeks=[week])
    assert calls.reconstructed == ["a"] * 3
    assert {scene.provenance.week for scene in SceneBank.open(tmp_path)} == {2}


def test_another_recording_of_the_same_name_rebuilds(calls: Calls, tmp_path: Path) -> None:
    for row in (recording("a"), recording("a"), recording("a", shade=1)):
        built(tmp_path / "bank", [row])
    assert calls.reconstructed == ["a", "a"]
    hashes = [scene.provenance.recording_sha256 for scene in SceneBank.open(tmp_path / "bank")]
    assert len(set(hashes)) == 1
    assert hashes[0] is not None


def test_an_interrupted_build_goes_on_with_the_scene_at_which_it_stopped(calls: Calls, tmp_path: Path) -> None:
    calls.fail_at = "b-01"
    with pytest.raises(KeyboardInterrupt):
        built(tmp_path)
    assert calls.certified == ["a-00", "a-01", "a-02", "b-00"]
    calls.fail_at = None
    before = {path.name: path.read_bytes() for path in tmp_path.glob("*.json")}
    assert len(built(tmp_path)) == 9
    assert calls.reconstructed == ["a", "b", "a-1"]
    assert calls.certified == ["a-00", "a-01", "a-02", "b-00", "b-01", "b-02", "a-1-00", "a-1-01", "a-1-02"]
    assert all((tmp_path / name).read_bytes() == content for name, content in before.items())
    assert len(list(tmp_path.iterdir())) == 10


def test_an_interrupted_build_of_other_images_is_not_continued(calls: Calls, tmp_path: Path) -> None:
    calls.fail_at = "a-01"
    with pytest.raises(KeyboardInterrupt):
        built(tmp_path, [recording("a")])
    calls.fail_at = None
    built(tmp_path, [recording("a", shade=1)])
    assert calls.reconstructed == ["a", "a"]
    assert calls.certified == ["a-00", "a-00", "a-01", "a-02"]


def test_a_folder_that_cannot_be_written_is_told_before_any_work(calls: Calls, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file" / "bank"):
        with pytest.raises(FileWriteError, match="cannot be written"):
            built(out)
    with exclusive(tmp_path / "bank"), pytest.raises(FileWriteError, match="another process is at work in this folder"):
        built(tmp_path / "bank")
    assert calls.reconstructed == []


@pytest.mark.parametrize("name", ["../../evil", "/abs/x", "a/b", ""])
def test_recordings_whose_names_lead_elsewhere_are_refused(calls: Calls, tmp_path: Path, name: str) -> None:
    with pytest.raises(InvalidValueError, match="a recording to build of cannot be named"):
        built(tmp_path / "bank", [recording(name)])
    assert calls.reconstructed == []


def test_stages_are_told(calls: Calls, tmp_path: Path) -> None:
    told: list[str] = []
    build_bank([recording("a")], tmp_path, "b", on_progress=told.append)
    build_bank([recording("a")], tmp_path, "b", on_progress=told.append)
    assert told[0] == "a: reconstructing 20 stations"
    assert told[-1] == "a: 3 scenes already built"


@pytest.mark.parametrize(
    "options",
    [
        {"rows": []},
        {"rows": [recording("a"), recording("a")]},
        {"splits": ["train"]},
        {"weeks": [1, 2]},
    ],
)
def test_lists_must_fit_together(calls: Calls, tmp_path: Path, options: dict[str, Any]) -> None:
    with pytest.raises(InvalidValueError, match="expected recordings with different names"):
        built(tmp_path, **options)
    assert calls.reconstructed == []


@pytest.mark.xdist_group("row")
def test_a_bank_from_a_recording_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every stage is the real one, but for the certificates."""
    from greenhouse_gym.capture import open_recording

    monkeypatch.setattr(build, "certify_targets", lambda scene, robot, max_targets, min_radius: ())
    opened = open_recording(write_recording(half_recording(), tmp_path / "recording"))
    bank = build_bank([opened], tmp_path / "bank", "real", on_progress=lambda text: None)
    (scene,) = bank
    assert scene.provenance.recording == "simulated-1"
    assert scene.provenance.recording_sha256 is not None
    assert len(scene.tomatoes) > 5
    assert len(scene.obstacles) <= BuildSettings().max_shapes
    assert {stem.kind for stem in scene.stems} >= {"main"}
    expected = extract_shapes(half_cloud().points, half_cloud().colors, half_cloud().normals)
    assert abs(len(scene.tomatoes) - len(expected.tomatoes)) <= 0.5 * len(expected.tomatoes)
    scene.to_mjcf("ur5e")
    assert scene.truth is not None
    off = [np.linalg.norm([t.center - f.center for t in scene.truth.tomatoes], axis=1).min() for f in scene.tomatoes]
    assert np.median(off) < 0.008
