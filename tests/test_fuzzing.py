"""Damaged files end in the package's own errors, or in a result that can be used."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import make_scene
from mutants import damaged_arrays, damaged_bytes, damaged_json

from greenhouse_gym.capture import Camera, Intrinsics, Recording, RgbdFrame, Rig, Station, open_recording
from greenhouse_gym.capture.formats.own import INDEX, write_recording
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.crops.truth_shapes import load_truth, save_truth
from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.geometry import pose
from greenhouse_gym.reconstruction import RowCloud, RowReport, StationReport, load_row, save_row
from greenhouse_gym.scene import Scene, SceneBank, Shapes
from greenhouse_gym.scene.bank import write_bank

MUTANTS = int(os.environ.get("GREENHOUSE_GYM_MUTANTS", "50"))
"""Per kind of file; 2,000 of each were tried."""

INTRINSICS = Intrinsics(16, 12, 10.0, 10.0, 7.5, 5.5)


def try_mutants(path: Path, damage: Callable[[bytes, int], bytes], use: Callable[[], object]) -> None:
    content = path.read_bytes()
    messages = []
    for seed in range(MUTANTS):
        path.write_bytes(damage(content, seed))
        try:
            use()
        except GreenhouseError as error:
            messages.append(str(error))
        except Exception as error:
            pytest.fail(f"mutant {seed} of {path.name}: {type(error).__name__}: {error!s:.300}")
    assert len(messages) >= 0.2 * MUTANTS
    assert max(map(len, messages)) < 2000


def test_scenes(tmp_path: Path) -> None:
    path = make_scene(0, stems=2).save(tmp_path / "scene.json")

    def use() -> None:
        scene = Scene.load(path)
        scene.save(tmp_path / "again.json")
        scene.to_mjcf()

    try_mutants(path, damaged_json, use)


def test_bank_manifests(tmp_path: Path) -> None:
    bank = write_bank(tmp_path / "bank", [(make_scene(i, stems=1), "train") for i in range(3)], name="b")
    try_mutants(bank.path / "manifest.json", damaged_json, lambda: list(SceneBank.open(bank.path)))


def test_truths(tmp_path: Path) -> None:
    scene = make_scene(0, stems=2)
    row = PlantRow(scene.tomatoes, scene.stems, scene.clutter, 1.0, 0)
    path = save_truth(row, tmp_path / "truth.npz")
    try_mutants(path, damaged_arrays, lambda: load_truth(path))


def test_scenes_with_truth(tmp_path: Path) -> None:
    plain = make_scene(0, stems=2)
    truth = Shapes(tomatoes=plain.tomatoes, stems=plain.stems, clutter=plain.clutter)
    path = plain.model_copy(update={"truth": truth}).save(tmp_path / "scene.json")

    def in_the_truth(content: bytes, seed: int) -> bytes:
        tree = json.loads(content)
        return json.dumps(tree | {"truth": "TRUTH"}).encode().replace(
            b'"TRUTH"', damaged_json(json.dumps(tree["truth"]).encode(), seed)
        )  # fmt: skip

    try_mutants(path, in_the_truth, lambda: Scene.load(path).truth)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
    frame = RgbdFrame(color, rng.uniform(0.3, 1.0, (12, 16)).astype(np.float32), INTRINSICS)
    rig = Rig({"c": Camera(INTRINSICS, np.eye(4))}, "c")
    written = Recording("tiny", rig, 2, lambda i: Station({"c": frame}, pose(translation=[0, 0.1 * i, 0])))
    return write_recording(written, tmp_path / "recording")


def read_all(path: Path) -> None:
    for station in open_recording(path):
        for frame in station.frames.values():
            frame.points()


def test_recording_indexes(recording: Path) -> None:
    try_mutants(recording / INDEX, damaged_json, lambda: read_all(recording))


@pytest.mark.parametrize("kind", ["color", "depth"])
def test_png_images(recording: Path, kind: str) -> None:
    try_mutants(recording / kind / "c" / "000000.png", damaged_bytes, lambda: read_all(recording))


@pytest.fixture
def single(tmp_path: Path) -> Path:
    """A folder of which each test makes a recording of another format."""
    folder = tmp_path / "single"
    (folder / "depth").mkdir(parents=True)
    (folder / "depth" / "0.png").write_bytes(cv2.imencode(".png", np.full((12, 16), 500, np.uint16))[1].tobytes())
    return folder


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("camera_x.yaml", "image_width: 16\nimage_height: 12\ncamera_matrix: [10, 0, 7.5, 0, 10, 5.5, 0, 0, 1]\n"),
        ("groundtruth_handeye.txt", "0 0 0 1 0 0 0 1\n3 0.1 0.2 0.3 0 0 0.7 0.7\n"),
    ],
)
def test_calibrated_folders(single: Path, name: str, content: str) -> None:
    (single / "rgb").mkdir()
    (single / "rgb" / "0.png").write_bytes(cv2.imencode(".png", np.zeros((12, 16, 3), np.uint8))[1].tobytes())
    (single / "camera_x.yaml").write_text(
        "image_width: 16\nimage_height: 12\ncamera_matrix: [10, 0, 7.5, 0, 10, 5.5, 0, 0, 1]\n"
    )
    (single / name).write_text(content)
    try_mutants(single / name, damaged_bytes, lambda: read_all(single))


@pytest.mark.parametrize("name", ["camera.json", "trajectory.log", "color/0.jpg"])
def test_open3d_folders(single: Path, name: str) -> None:
    (single / "color").mkdir()
    (single / "color" / "0.jpg").write_bytes(cv2.imencode(".jpg", np.zeros((12, 16, 3), np.uint8))[1].tobytes())
    camera = {"width": 16, "height": 12, "intrinsic_matrix": [10.0, 0, 0, 0, 10, 0, 7.5, 5.5, 1]}
    (single / "camera.json").write_text(json.dumps(camera))
    (single / "trajectory.log").write_text("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    damage = damaged_json if name.endswith("json") else damaged_bytes
    try_mutants(single / name, damage, lambda: read_all(single))


def test_row_clouds(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    poses = np.array([np.eye(4), np.full((4, 4), np.nan), pose(translation=[0, 0.2, 0])])
    reports = tuple(StationReport(i, i != 1, reason="" if i != 1 else "dark") for i in range(3))
    stations = np.array([0, 2] * 20, np.int32)
    row = RowCloud(
        *rng.uniform(size=(3, 40, 3)), stations, np.array([True, False, True]), poses, RowReport(reports, ((0, 2),))
    )
    path = save_row(row, tmp_path / "row.npz")

    def use() -> None:
        again = load_row(path)
        assert again.points.shape == again.colors.shape == again.normals.shape == (len(again.station), 3)
        assert np.isfinite(again.points).all()
        save_row(again, tmp_path / "again.npz")

    try_mutants(path, damaged_arrays, use)
