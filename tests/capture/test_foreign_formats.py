"""Layouts of others, written by OpenCV and numpy from a simulated walk, read back equal."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from row_helpers import HALF, half_recording
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture import Intrinsics, Recording, RgbdFrame, open_recording
from greenhouse_gym.capture.formats.pairs import Lens, Pair, aligned, read_units
from greenhouse_gym.capture.formats.videos import nearest_in_time
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, pose

pytestmark = pytest.mark.xdist_group("row")

CAMERA = HALF.cameras["middle"]
K = CAMERA.intrinsics
STATIONS = 3


def frames() -> list[RgbdFrame]:
    return [half_recording()[i].frames["middle"] for i in range(STATIONS)]


def poses() -> list[Array]:
    """World from camera of each frame."""
    found = [half_recording()[i].world_from_station for i in range(STATIONS)]
    return [place @ CAMERA.rig_from_camera for place in found if place is not None]


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, image)
    else:
        assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def units(depth: np.ndarray, scale: float) -> np.ndarray:
    return np.rint(depth / scale).astype(np.uint16)


def line(time: float, place: Array) -> str:
    numbers = [time, *place[:3, 3], *Rotation.from_matrix(place[:3, :3]).as_quat()]
    return " ".join(f"{x:.9f}" for x in numbers)


def as_tum(folder: Path) -> None:
    lists: dict[str, list[str]] = {"rgb": ["# color"], "depth": ["# depth"], "truth": ["# time tx ty tz qx qy qz qw"]}
    for i, (frame, place) in enumerate(zip(frames(), poses(), strict=True)):
        save(folder / f"rgb/{i}.png", frame.color)
        save(folder / f"depth/{i}.png", units(frame.depth, 1 / 5000))
        lists["rgb"].append(f"{100 + i:.6f} rgb/{i}.png")
        lists["depth"].append(f"{100.011 + i:.6f} depth/{i}.png")
        lists["truth"].append(line(100.004 + i, place))
    for name, file in (("rgb", "rgb.txt"), ("depth", "depth.txt"), ("truth", "groundtruth.txt")):
        (folder / file).write_text("\n".join(lists[name]) + "\n")
    (folder / "calibration.txt").write_text(f"{K.fx} {K.fy} {K.cx} {K.cy}\n")


def as_scannet(folder: Path) -> None:
    for i, (frame, place) in enumerate(zip(frames(), poses(), strict=True)):
        save(folder / f"color/{i}.png", frame.color)
        save(folder / f"depth/{i}.png", units(frame.depth, 0.001))
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / f"pose/{i}.txt", place)
    for kind in ("color", "depth"):
        (folder / "intrinsic").mkdir(exist_ok=True)
        matrix = np.eye(4)
        matrix[:3, :3] = K.matrix
        np.savetxt(folder / f"intrinsic/intrinsic_{kind}.txt", matrix)


def as_open3d_recorder(folder: Path) -> None:
    log = []
    for i, (frame, place) in enumerate(zip(frames(), poses(), strict=True)):
        save(folder / f"color/{i:05d}.png", frame.color)
        save(folder / f"depth/{i:05d}.png", units(frame.depth, 0.001))
        log += [f"{i} {i} {i + 1}", *(" ".join(map(repr, row)) for row in place.tolist())]
    (folder / "trajectory.log").write_text("\n".join(log))
    camera = {
        "width": K.width,
        "height": K.height,
        "intrinsic_matrix": K.matrix.T.ravel().tolist(),
        "depth_scale": 1000,
    }
    (folder / "intrinsic.json").write_text(json.dumps(camera))


def as_described(suffix: str, scale: float) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        for i, frame in enumerate(frames()):
            save(folder / f"c/{i}.jpg.png", frame.color)
            save(folder / f"d/{i}{suffix}", units(frame.depth, scale) if scale else frame.depth)
        lines = [line(i, place) for i, place in enumerate(poses())]
        (folder / "poses.txt").write_text("\n".join(lines))
        intrinsics = {name: getattr(K, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        content = {"color": "c/*.png", "depth": f"d/*{suffix}", "depth_scale": scale or 1.0, "intrinsics": intrinsics}
        (folder / "cameras.yaml").write_text(json.dumps(content | {"poses": "poses.txt"}))  # JSON is YAML

    return write


FORMATS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "tum": ("tum", as_tum),
    "scannet": ("scannet", as_scannet),
    "open3d": ("open3d", as_open3d_recorder),
    "png of 0.2 mm": ("described", as_described(".png", 0.0002)),
    "npy of metres": ("described", as_described(".npy", 0.0)),
    "npy of units": ("described", as_described(".npy", 0.001)),
    "tiff of metres": ("described", as_described(".tiff", 0.0)),
}


def written(name: str, folder: Path) -> Recording:
    folder.mkdir(parents=True, exist_ok=True)
    FORMATS[name][1](folder)
    return open_recording(folder)


@pytest.mark.parametrize("name", FORMATS)
def test_a_walk_in_a_layout_of_others_is_read_back(tmp_path: Path, name: str) -> None:
    recording = written(name, tmp_path / "walk")
    assert len(recording) == STATIONS
    assert open_recording(tmp_path / "walk", format=FORMATS[name][0]).size == STATIONS
    for station, frame, place in zip(recording, frames(), poses(), strict=True):
        found = station.frames["camera"]
        np.testing.assert_array_equal(found.color, frame.color)
        np.testing.assert_allclose(found.depth, frame.depth, atol=1e-6)
        for parameter in ("fx", "fy", "cx", "cy"):
            assert getattr(found.intrinsics, parameter) == pytest.approx(getattr(K, parameter))
        assert station.world_from_station is not None
        camera = station.world_from_station @ recording.rig.cameras["camera"].rig_from_camera
        np.testing.assert_allclose(camera, place, atol=1e-6)


def test_images_without_a_partner_in_time_are_left_out_and_told(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("name", ["x.exr", "x.npy", "x.png", "x.tiff"])
def test_what_is_no_depth_image_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(FileFormatError, match=name):
        read_units(tmp_path / name)
    save(tmp_path / "8.png", np.zeros((4, 4), np.uint8))
    with pytest.raises(FileFormatError, match="one channel of depth"):
        read_units(tmp_path / "8.png")


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
