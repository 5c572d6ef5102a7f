"""A track of one camera written by OpenCV and numpy in the layouts of others."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture import Recording, RgbdFrame
from greenhouse_gym.geometry import Array, invert


class CameraTrack(NamedTuple):
    """Images of one camera and its poses (4, 4) in the world."""

    frames: Sequence[RgbdFrame]
    world_from_camera: Sequence[Array]


def track_of(recording: Recording, camera: str) -> CameraTrack:
    """The track of a camera of a recording whose poses are known."""
    stations = list(recording)
    place = recording.rig.cameras[camera].rig_from_camera
    known = [station.world_from_station @ place for station in stations if station.world_from_station is not None]
    return CameraTrack([station.frames[camera] for station in stations], known)


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, image)
    elif path.suffix == ".exr":
        import OpenEXR

        with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Z": np.ascontiguousarray(image)}) as file:
            file.write(str(path))
    else:
        assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def units(depth: np.ndarray, scale: float) -> np.ndarray:
    return np.rint(depth / scale).astype(np.uint16)


def line(time: float, place: Array) -> str:
    numbers = [time, *place[:3, 3], *Rotation.from_matrix(place[:3, :3]).as_quat()]
    return " ".join(f"{x:.9f}" for x in numbers)


def as_tum(folder: Path, track: CameraTrack) -> None:
    lists: dict[str, list[str]] = {"rgb": ["# color"], "depth": ["# depth"], "truth": ["# time tx ty tz qx qy qz qw"]}
    for i, (frame, place) in enumerate(zip(*track, strict=True)):
        save(folder / f"rgb/{i}.png", frame.color)
        save(folder / f"depth/{i}.png", units(frame.depth, 1 / 5000))
        lists["rgb"].append(f"{100 + i:.6f} rgb/{i}.png")
        lists["depth"].append(f"{100.011 + i:.6f} depth/{i}.png")
        lists["truth"].append(line(100.004 + i, place))
    for name, file in (("rgb", "rgb.txt"), ("depth", "depth.txt"), ("truth", "groundtruth.txt")):
        (folder / file).write_text("\n".join(lists[name]) + "\n")
    k = track.frames[0].intrinsics
    (folder / "calibration.txt").write_text(f"{k.fx} {k.fy} {k.cx} {k.cy}\n")


def as_scannet(folder: Path, track: CameraTrack) -> None:
    for i, (frame, place) in enumerate(zip(*track, strict=True)):
        save(folder / f"color/{i}.png", frame.color)
        save(folder / f"depth/{i}.png", units(frame.depth, 0.001))
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / f"pose/{i}.txt", place)
    for kind in ("color", "depth"):
        (folder / "intrinsic").mkdir(exist_ok=True)
        matrix = np.eye(4)
        matrix[:3, :3] = track.frames[0].intrinsics.matrix
        np.savetxt(folder / f"intrinsic/intrinsic_{kind}.txt", matrix)


def as_bop(folder: Path, track: CameraTrack) -> None:
    cameras = {}
    for i, (frame, place) in enumerate(zip(*track, strict=True)):
        save(folder / f"rgb/{i:06d}.png", frame.color)
        save(folder / f"depth/{i:06d}.png", units(frame.depth, 0.0001))
        there = invert(place)
        cameras[i] = {
            "cam_K": frame.intrinsics.matrix.ravel().tolist(),
            "depth_scale": 0.1,
            "cam_R_w2c": there[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1000 * there[:3, 3]).tolist(),
        }
    (folder / "scene_camera.json").write_text(json.dumps(cameras))


def as_open3d_recorder(folder: Path, track: CameraTrack) -> None:
    log = []
    for i, (frame, place) in enumerate(zip(*track, strict=True)):
        save(folder / f"color/{i:05d}.png", frame.color)
        save(folder / f"depth/{i:05d}.png", units(frame.depth, 0.001))
        log += [f"{i} {i} {i + 1}", *(" ".join(map(repr, row)) for row in place.tolist())]
    (folder / "trajectory.log").write_text("\n".join(log))
    k = track.frames[0].intrinsics
    camera = {"width": k.width, "height": k.height, "intrinsic_matrix": k.matrix.T.ravel().tolist()}
    (folder / "intrinsic.json").write_text(json.dumps(camera | {"depth_scale": 1000}))


def as_described(suffix: str, scale: float) -> Callable[[Path, CameraTrack], None]:
    """Folders with a description; depth in units of ``scale`` metres, or in metres with a scale of 0."""

    def write(folder: Path, track: CameraTrack) -> None:
        content = described_camera(folder, "", track.frames, suffix, scale)
        lines = [line(i, place) for i, place in enumerate(track.world_from_camera)]
        (folder / "poses.txt").write_text("\n".join(lines))
        (folder / "cameras.yaml").write_text(json.dumps(content | {"poses": "poses.txt"}))  # JSON is YAML

    return write


def as_described_rig(folder: Path, recording: Recording) -> None:
    """Folders with a description of all cameras of a recording, poses of the rig included."""
    stations = list(recording)
    cameras: dict[str, Mapping[str, object]] = {}
    for name, camera in recording.rig.cameras.items():
        content = described_camera(folder, name, [station.frames[name] for station in stations], ".png", 0.001)
        cameras[name] = content | {"rig_from_camera": camera.rig_from_camera.tolist()}
    known = [station.world_from_station for station in stations if station.world_from_station is not None]
    (folder / "poses.txt").write_text("\n".join(line(i, place) for i, place in enumerate(known)))
    described = {"reference": recording.rig.reference, "poses": "poses.txt", "cameras": cameras}
    (folder / "cameras.yaml").write_text(json.dumps(described))


def described_camera(
    folder: Path, name: str, frames: Sequence[RgbdFrame], suffix: str, scale: float
) -> dict[str, object]:
    """A camera's images, and what ``cameras.yaml`` says of it."""
    for i, frame in enumerate(frames):
        save(folder / f"{name}c/{i:06d}.jpg.png", frame.color)
        save(folder / f"{name}d/{i:06d}{suffix}", units(frame.depth, scale) if scale else frame.depth)
    k = frames[0].intrinsics
    intrinsics = {part: getattr(k, part) for part in ("width", "height", "fx", "fy", "cx", "cy")}
    return {
        "color": f"{name}c/*.png", "depth": f"{name}d/*{suffix}", "depth_scale": scale or 1.0, "intrinsics": intrinsics
    }  # fmt: skip


LAYOUTS: dict[str, tuple[str, Callable[[Path, CameraTrack], None]]] = {
    "tum": ("tum", as_tum),
    "scannet": ("scannet", as_scannet),
    "open3d": ("open3d", as_open3d_recorder),
    "png of 0.2 mm": ("described", as_described(".png", 0.0002)),
    "npy of metres": ("described", as_described(".npy", 0.0)),
    "npy of units": ("described", as_described(".npy", 0.001)),
    "tiff of metres": ("described", as_described(".tiff", 0.0)),
    "exr of metres": ("described", as_described(".exr", 0.0)),
    "bop": ("bop", as_bop),
}
"""Layouts of a single camera: the format that reads each, and what writes it."""
