"""Damaged bags, folders, rigs, arms, policies and settings in a process of its own."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
import pytest
from bag_writer import MCAP, ROS1, SQLITE, Writer
from fuzzing import Source, assert_all_end_well, assert_what_is_no_file_does_no_harm
from layouts import CameraTrack, as_described, save
from mutants import damaged_bytes, damaged_json, damaged_numbers
from robots.test_arm_files import arm_text

from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.capture import Intrinsics, RgbdFrame, open_recording
from greenhouse_gym.capture.rig_file import load_mounting
from greenhouse_gym.common.settings_files import as_toml, resolve
from greenhouse_gym.reconstruction import ReconstructionSettings
from greenhouse_gym.robots import ROBOTS, load_robot

LENS = Intrinsics(16, 12, 10.0, 10.0, 8.0, 6.0)
CAMERA = json.dumps({**vars(LENS), "distortion": [0.1, 0, 0, 0, 0], "distortion_model": "plumb_bob"})
CALIBRATION = (
    "image_width: 16\nimage_height: 12\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [10, 0, 8, 0, 10, 6, 0, 0, 1]\n"
    "distortion_model: plumb_bob\ndistortion_coefficients: [0.1, 0, 0, 0, 0]\n"
)
TIMED = "".join(f"{i} {i} 0.2 0.3 0 0 0.7 0.7\n" for i in range(2))
LOG = "".join(f"{i} {i} {i + 1}\n1 0 0 {i}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n" for i in range(2))


def read(path: Path) -> None:
    for station in open_recording(path):
        for frame in station.frames.values():
            frame.points()


def bag(container: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        frame = RgbdFrame(np.full((12, 16, 3), 90, np.uint8), np.ones((12, 16), np.float32), LENS)
        path = folder / ("walk.bag" if container == ROS1 else "walk")
        with Writer(path, container, LENS) as writer:
            writer.camera("/camera", [frame] * 2)
            for i in range(2):
                writer.pose("/odom", np.eye(4), 1_700_000_000 * 10**9 + i)
                if container != ROS1:
                    writer.transform("/tf", "odom", "camera", np.eye(4), 1_700_000_000 * 10**9 + i)
        return path if container == ROS1 else next(file for file in path.iterdir() if file.suffix != ".yaml")

    return write


def use_bag(path: Path) -> None:
    read(path if path.suffix == ".bag" else path.parent)


def folder_with(damaged: str, texts: Mapping[str, str], rgb: str, suffix: str) -> Callable[[Path], Path]:
    """A folder of two images of color and depth with some files, one of them damaged."""

    def write(folder: Path) -> Path:
        for kind, image in ((rgb, np.zeros((12, 16, 3), np.uint8)), ("depth", np.full((12, 16), 500, np.uint16))):
            (folder / kind).mkdir(parents=True)
            for i in range(2):
                cv2.imwrite(str(folder / kind / f"{i}.{suffix if kind == rgb else 'png'}"), image)
        for name, text in texts.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)
        return folder / damaged

    return write


def folder_of(path: Path) -> None:
    read(path.parent if (path.parent / "depth").is_dir() else path.parent.parent)


def in_folder(damaged: str, texts: Mapping[str, str], rgb: str = "rgb", suffix: str = "png") -> Source:
    damages = (damaged_json,) if damaged.endswith(".json") else (damaged_bytes, damaged_numbers)
    least = 0.0 if damaged.endswith((".jpg", ".png")) else 0.1
    return Source(folder_with(damaged, texts, rgb, suffix), folder_of, damages, least)


def depth_image(suffix: str, image: np.ndarray) -> Source:
    """A described folder with depth in another format than PNG."""

    def write(folder: Path) -> Path:
        frame = RgbdFrame(np.zeros((12, 16, 3), np.uint8), np.ones((12, 16), np.float32), LENS)
        as_described(suffix, 0.0)(folder, CameraTrack([frame] * 2, [np.eye(4)] * 2))
        save(folder / f"d/000001{suffix}", image)
        return folder / f"d/000001{suffix}"

    return Source(write, folder_of, (damaged_bytes, damaged_numbers), 0.0)


BALL = "\n".join(f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1)) + "\nf 1 2 3\nf 4 6 7\nf 8 1 6\n"
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], "<i4")


def stl() -> bytes:
    facets = [np.zeros(3, "<f4").tobytes() + CORNERS[face].tobytes() + bytes(2) for face in FACES]
    return bytes(80) + len(facets).to_bytes(4, "little") + b"".join(facets)


def msh() -> bytes:
    return np.array([4, 0, 0, 4], "<i4").tobytes() + CORNERS.tobytes() + FACES.tobytes()


def png() -> bytes:
    return cv2.imencode(".png", np.arange(192, dtype=np.uint8).reshape(8, 8, 3))[1].tobytes()


def asset(name: str, content: bytes, kind: str, geom: str) -> Source:
    """A file that an arm's file names."""

    def write(folder: Path) -> Path:
        head = f'<asset><{kind} name="m" file="{name}"/>{geom.partition("|")[2]}</asset>'
        (folder / "arm.xml").write_text(arm_text(head, inside=geom.partition("|")[0]))
        (folder / name).write_bytes(content)
        return folder / name

    return Source(write, lambda path: load_robot(path.parent / "arm.xml"), (damaged_bytes, damaged_numbers), 0.0)


MESH = '<geom type="mesh" mesh="m" mass="1" contype="0" conaffinity="0"/>'
TEXTURE = '<geom type="box" size="0.01 0.01 0.01" material="t"/>|<material name="t" texture="m"/>'


def policy(damaged: str) -> Source:
    """A policy with damaged weights, or a damaged description; the checksum in it fits in any case."""

    def write(folder: Path) -> Path:
        rng = np.random.default_rng(0)
        weights = tuple(rng.normal(size=size).astype(np.float32) for size in ((8, 6), (6, 8)))
        Policy(
            weights=weights, biases=(np.zeros(8, np.float32), np.zeros(6, np.float32)), activation="tanh",
            center=np.zeros(6, np.float32), scale=np.ones(6, np.float32), env_options={}, layout=(),
        ).save(folder / "policy")  # fmt: skip
        return folder / f"policy.{damaged}"

    def use(path: Path) -> None:
        description = path.with_suffix(".json")
        if damaged == "safetensors" and path.is_file():
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            description.write_text(json.dumps(json.loads(description.read_text()) | {"weights_sha256": digest}))
        loaded = Policy.load(path)
        loaded(np.zeros(len(loaded.center), np.float32))

    return Source(write, use, (damaged_json,) if damaged == "json" else (damaged_bytes, damaged_numbers))


def text_file(name: str, content: str | Callable[[], str], use: Callable[[Path], object], least: float = 0.2) -> Source:
    def write(folder: Path) -> Path:
        (folder / name).write_text(content if isinstance(content, str) else content())
        return folder / name

    damages = (damaged_json,) if name.endswith(".json") else (damaged_bytes, damaged_numbers)
    return Source(write, use, damages, least)


DESCRIBED = {
    "cameras.yaml": f"color: rgb/*.png\ndepth: depth/*.png\nposes: p.txt\nintrinsics: {CAMERA}\n",
    "p.txt": TIMED,
}
TUM = {"rgb.txt": "0 rgb/0.png\n1 rgb/1.png\n", "depth.txt": "0 depth/0.png\n1 depth/1.png\n",
       "groundtruth.txt": TIMED, "calibration.txt": "10 10 8 6 16 12\n"}  # fmt: skip
OPEN3D = {"camera.json": '{"width": 16, "height": 12, "intrinsic_matrix": [10, 0, 0, 0, 10, 0, 8, 6, 1]}',
          "trajectory.log": LOG}  # fmt: skip
MATRIX = "10 0 8 0\n0 10 6 0\n0 0 1 0\n0 0 0 1\n"
POSE = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
SCANNET = {"intrinsic/intrinsic_color.txt": MATRIX, "intrinsic/intrinsic_depth.txt": MATRIX, "pose/0.txt": POSE}
RIG = f"reference: c\ncameras:\n  c: {{rig_from_camera: {np.eye(4).tolist()}, depth_error: 0.01}}\n"

SOURCES: Mapping[str, Source] = MappingProxyType(
    {
        "ROS 1 bag": Source(bag(ROS1), use_bag, (damaged_bytes, damaged_numbers), 0.1),
        "ROS 2 bag in MCAP": Source(bag(MCAP), use_bag, (damaged_bytes, damaged_numbers), 0.1),
        "ROS 2 bag in SQLite": Source(bag(SQLITE), use_bag, (damaged_bytes, damaged_numbers), 0.0),
        "cameras.yaml": in_folder("cameras.yaml", DESCRIBED),
        "poses": in_folder("p.txt", DESCRIBED),
        "TUM list": in_folder("rgb.txt", TUM),
        "TUM poses": in_folder("groundtruth.txt", TUM),
        "Open3D camera": in_folder("camera.json", OPEN3D, "color"),
        "Open3D trajectory": in_folder("trajectory.log", OPEN3D, "color"),
        "ScanNet matrix": in_folder("intrinsic/intrinsic_depth.txt", SCANNET, "color"),
        "calibration": in_folder("camera_x.yaml", {"camera_x.yaml": CALIBRATION}),
        "JPEG": in_folder("color/0.jpg", OPEN3D, "color", "jpg"),
        "PNG": in_folder("depth/1.png", OPEN3D, "color"),
        "TIFF": depth_image(".tiff", np.full((12, 16), 500, np.uint16)),
        "TIFF of fractions": depth_image(".tiff", np.ones((12, 16), np.float32)),
        "EXR": depth_image(".exr", np.ones((12, 16), np.float32)),
        "policy's description": policy("json"),
        "policy's weights": policy("safetensors"),
        "arm's STL": asset("m.stl", stl(), "mesh", MESH),
        "arm's OBJ": asset("m.obj", BALL.encode(), "mesh", MESH),
        "arm's MSH": asset("m.msh", msh(), "mesh", MESH),
        "arm's texture": asset("m.png", png(), 'texture type="2d"', TEXTURE),
        "rig file": text_file("rig.yaml", RIG, load_mounting),
        "arm": text_file("arm.xml", arm_text, load_robot, 0.1),
        "shipped arm": text_file("arm.xml", ROBOTS["ur5e"].read_text, load_robot, 0.1),
        "settings in TOML": text_file(
            "s.toml", lambda: as_toml(ReconstructionSettings(), comments=True),
            lambda path: resolve(ReconstructionSettings(), path), 0.05,
        ),
        "settings in JSON": text_file(
            "s.json", '{"foreground": 0.7, "poses": "given", "calibration_stations": 3}',
            lambda path: resolve(ReconstructionSettings(), path),
        ),
    }
)  # fmt: skip


@pytest.fixture(autouse=True)
def _bags() -> None:
    pytest.importorskip("rosbags")


def test_some_mutants_of_each_kind(tmp_path: Path) -> None:
    assert_all_end_well(__name__, tmp_path, [(kind, 0, 10) for kind in SOURCES])


@pytest.mark.timeout(60)
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes among the files of this system")
@pytest.mark.parametrize("kind", SOURCES)
def test_what_is_no_file_does_no_harm(tmp_path: Path, kind: str) -> None:
    assert_what_is_no_file_does_no_harm(SOURCES[kind], tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("kind", SOURCES)
def test_2000_mutants_of_each_kind(tmp_path: Path, kind: str) -> None:
    assert_all_end_well(__name__, tmp_path, [(kind, 0, 2000)])
