"""Layouts of others, written by OpenCV and numpy from a simulated recording, read back equal."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from layouts import LAYOUTS, CameraTrack, save, track_of
from row_helpers import HALF, half_recording
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture import Intrinsics, Recording, open_recording
from greenhouse_gym.capture.formats.image_lists import nearest_in_time
from greenhouse_gym.capture.formats.single_camera import Lens, Pair, aligned
from greenhouse_gym.capture.image_files import read_any_depth
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, pose

pytestmark = pytest.mark.xdist_group("row")

CAMERA = HALF.cameras["middle"]
K = CAMERA.intrinsics
STATIONS = 3


def track() -> CameraTrack:
    whole = track_of(half_recording(), "middle")
    return CameraTrack(whole.frames[:STATIONS], whole.world_from_camera[:STATIONS])


def written(name: str, folder: Path) -> Recording:
    if name.startswith("exr"):
        pytest.importorskip("OpenEXR")
    folder.mkdir(parents=True, exist_ok=True)
    LAYOUTS[name][1](folder, track())
    return open_recording(folder)


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_recording_in_a_layout_of_others_is_read_back(tmp_path: Path, name: str) -> None:
    recording = written(name, tmp_path / "walk")
    assert len(recording) == STATIONS
    assert open_recording(tmp_path / "walk", format=LAYOUTS[name][0]).size == STATIONS
    for station, frame, place in zip(recording, *track(), strict=True):
        found = station.frames["camera"]
        np.testing.assert_array_equal(found.color, frame.color)
        np.testing.assert_allclose(found.depth, frame.depth, atol=1e-6)
        for parameter in ("fx", "fy", "cx", "cy"):
            assert getattr(found.intrinsics, parameter) == pytest.approx(getattr(K, parameter))
        assert station.world_from_station is not None
        camera = station.world_from_station @ recording.rig.cameras["camera"].rig_from_camera
        np.testing.assert_allclose(camera, place, atol=1e-6)


def test_images_without_a_partner_in_time_are_left_out_and_reported(tmp_path: Path) -> None:
    written("tum", tmp_path)
    lines = (tmp_path / "depth.txt").read_text().splitlines()
    (tmp_path / "depth.txt").write_text("\n".join([lines[0], lines[1], lines[3]]))
    recording = open_recording(tmp_path)
    assert len(recording) == 2
    assert "1 of 3 color images have no depth" in recording.notes[0]
    (tmp_path / "depth.txt").write_text("5.0 depth/0.png\n")
    with pytest.raises(FileFormatError, match="no pairs"):
        open_recording(tmp_path)


def test_nearest_in_time() -> None:
    near = nearest_in_time(np.array([0.0, 1.0, 2.0]), np.array([0.9, 1.2, 2.5]), 0.15)
    assert near.tolist() == [-1, 0, -1]
    assert nearest_in_time(np.array([0.0]), np.zeros(0), 1.0).tolist() == [-1]
    assert nearest_in_time(np.array([0.0, 5.0]), np.array([0.1]), 1.0).tolist() == [0, -1]


MISFITS: list[tuple[dict[str, object], str]] = [
    ({"depth_scale": -1}, "depth_scale"),
    ({"color": "nothing/*.png"}, "equally many"),
    ({"color": "../*.png"}, "leads out"),
    ({"colour": "c/*.png"}, "colour"),
    ({"intrinsics": {"width": 4}}, "intrinsics"),
    ({"poses": "/etc/passwd"}, "inside"),
]


@pytest.mark.parametrize(("change", "what"), MISFITS)
def test_a_description_that_does_not_fit_is_refused(tmp_path: Path, change: dict[str, object], what: str) -> None:
    written("npy of units", tmp_path)
    content = json.loads((tmp_path / "cameras.yaml").read_text()) | change
    (tmp_path / "cameras.yaml").write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match=what):
        open_recording(tmp_path)


def test_an_exr_of_several_channels_and_a_cut_one(tmp_path: Path) -> None:
    exr = pytest.importorskip("OpenEXR")
    depth = half_recording()[0].frames["middle"].depth
    for name, channels in (("zb.exr", {"depth.Z": depth, "B": depth + 1}), ("bg.exr", {"B": depth, "G": depth})):
        with exr.File({"type": exr.scanlineimage}, channels) as file:
            file.write(str(tmp_path / name))
    np.testing.assert_array_equal(read_any_depth(tmp_path / "zb.exr"), depth)
    with pytest.raises(FileFormatError, match="which of its channels B, G is depth"):
        read_any_depth(tmp_path / "bg.exr")
    (tmp_path / "cut.exr").write_bytes((tmp_path / "zb.exr").read_bytes()[:2000])
    with pytest.raises(FileFormatError, match=r"cut\.exr"):
        read_any_depth(tmp_path / "cut.exr")


def test_a_scene_of_bop_with_two_cameras_is_refused(tmp_path: Path) -> None:
    written("bop", tmp_path)
    file = tmp_path / "scene_camera.json"
    content = json.loads(file.read_text())
    content["1"]["cam_K"][0] += 1
    file.write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match="image 1 has another camera than image 0"):
        open_recording(tmp_path)


@pytest.mark.parametrize("name", ["x.exr", "x.npy", "x.png", "x.tiff"])
def test_what_is_no_depth_image_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(FileFormatError, match=name):
        read_any_depth(tmp_path / name)
    save(tmp_path / "8.png", np.zeros((4, 4), np.uint8))
    with pytest.raises(FileFormatError, match="one channel of depth"):
        read_any_depth(tmp_path / "8.png")


# -- two lenses -------------------------------------------------------------------------------------------------------


def wall(k: Intrinsics, metres: float, camera_from_wall: Array) -> np.ndarray:
    """Depth of a plane z = ``metres`` of the wall's frame, pixel by pixel."""
    v, u = np.indices((k.height, k.width))
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1)
    normal = camera_from_wall[:3, 2]
    offset = metres + normal @ camera_from_wall[:3, 3]
    return (offset / (rays @ normal)).astype(np.float32)


@pytest.mark.parametrize("size", [(848, 480, 424.0), (212, 120, 106.0)])
def test_depth_is_aligned_to_color(size: tuple[int, int, float]) -> None:
    own = Intrinsics(size[0], size[1], size[2], size[2], size[0] / 2 - 0.5, size[1] / 2 - 0.5)
    color = Intrinsics(424, 240, 300.0, 300.0, 211.5, 119.5)
    color_from_depth = pose(Rotation.from_rotvec([0.0, 0.02, 0.01]).as_matrix(), [0.015, 0.001, 0.0])
    found = aligned(wall(own, 0.6, np.eye(4)), own, color, color_from_depth)
    expected = wall(color, 0.6, color_from_depth)
    middle = (slice(40, 200), slice(60, 360))
    assert (found[middle] > 0).mean() > 0.995
    seen = found[middle] > 0
    assert np.abs(found[middle][seen] - expected[middle][seen]).max() < 0.001


def test_what_is_behind_is_hidden_by_what_is_in_front() -> None:
    k = Intrinsics(40, 30, 30.0, 30.0, 19.5, 14.5)
    depth = np.full((30, 40), 1.0, np.float32)
    depth[:, 20:] = 0.3
    found = aligned(depth, k, k, pose(translation=[-0.2, 0.0, 0.0]))
    assert set(np.unique(found).tolist()) <= {0.0, np.float32(0.3), np.float32(1.0)}
    assert (found[:, :19] == np.float32(0.3)).any()


def test_distortion_is_undone() -> None:
    """A grid drawn through OpenCV's model comes out straight."""
    k, bent = Intrinsics(320, 240, 250.0, 250.0, 159.5, 119.5), (-0.25, 0.08, 0.001, -0.001)
    v, u = np.indices((240, 320))
    points = cv2.undistortPoints(
        np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(np.float64), k.matrix, np.array(bent)
    ).reshape(240, 320, 2)
    depth = (1.0 + 0.5 * points[..., 0]).astype(np.float32)
    color = np.repeat((128 + 200 * points[..., :1]).clip(0, 255), 3, axis=2).astype(np.uint8)
    frame = Pair(Lens(k, bent)).frame(color, depth, "test")
    expected = 1.0 + 0.5 * (u - k.cx) / k.fx
    inner = (slice(20, 220), slice(20, 300))
    assert np.abs(frame.depth[inner] - expected[inner]).max() < 0.002
    assert np.abs(frame.color[inner][..., 0] - (128 + 200 * (u - k.cx) / k.fx)[inner]).max() < 2
