"""Texts that an editor saved with a byte order mark, or as UTF-16, are read like others."""

from __future__ import annotations

import codecs
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import make_scene

from greenhouse_gym.capture import open_recording
from greenhouse_gym.capture.rig_file import load_mounting
from greenhouse_gym.common.settings_files import resolve
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.reconstruction import ReconstructionSettings
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.bank import write_bank

ENCODINGS = ["utf-8-sig", "utf-16", "utf-16-be"]
LENS = {"width": 16, "height": 12, "fx": 10.0, "fy": 10.0, "cx": 8.0, "cy": 6.0}


def as_editors_save(path: Path, encoding: str) -> None:
    mark = codecs.BOM_UTF16_BE if encoding == "utf-16-be" else b""
    path.write_bytes(mark + path.read_text().encode(encoding))


def write_images(folder: Path, *parts: str) -> None:
    for part in parts:
        (folder / part).mkdir(parents=True)
        image = np.full((12, 16), 900, np.uint16) if "depth" in part else np.zeros((12, 16, 3), np.uint8)
        cv2.imwrite(str(folder / part / "000000.png"), image)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_recordings(tmp_path: Path, encoding: str) -> None:
    own, tum, open3d, bop, scannet, described = (tmp_path / name for name in ("own", "tum", "open3d", "bop", "s", "d"))
    write_images(own, "color/c", "depth/c")
    camera = LENS | {"rig_from_camera": np.eye(4).tolist(), "depth_scale": 0.001}
    station = {"color": {"c": "color/c/000000.png"}, "depth": {"c": "depth/c/000000.png"}}
    index = {"schema_version": 1, "name": "r", "reference": "c", "cameras": {"c": camera}, "stations": [station]}
    (own / "recording.json").write_text(json.dumps(index))
    write_images(tum, "rgb", "depth")
    for kind in ("rgb", "depth"):
        (tum / f"{kind}.txt").write_text(f"1000.0 {kind}/000000.png\n")
    (tum / "calibration.txt").write_text("10 10 8 6 16 12")
    (tum / "groundtruth.txt").write_text("1000.0 1 2 3 0 0 0 1\n")
    write_images(open3d, "color", "depth")
    (open3d / "camera.json").write_text(
        '{"width": 16, "height": 12, "intrinsic_matrix": [10, 0, 0, 0, 10, 0, 8, 6, 1]}'
    )
    (open3d / "trajectory.log").write_text("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    write_images(bop, "rgb", "depth")
    (bop / "scene_camera.json").write_text('{"0": {"cam_K": [10, 0, 8, 0, 10, 6, 0, 0, 1], "depth_scale": 1.0}}')
    write_images(scannet, "color", "depth", "intrinsic", "pose")
    for name in ("intrinsic/intrinsic_color", "intrinsic/intrinsic_depth", "pose/000000"):
        (scannet / f"{name}.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    write_images(described, "rgb", "depth")
    (described / "cameras.yaml").write_text(
        f"color: rgb/*.png\ndepth: depth/*.png\nposes: p.txt\nintrinsics: {json.dumps(LENS)}\n"
    )
    (described / "p.txt").write_text("0 1 2 3 0 0 0 1\n")
    for folder in (own, tum, open3d, bop, scannet, described):
        for file in folder.rglob("*"):
            if file.suffix in (".json", ".txt", ".log", ".yaml"):
                as_editors_save(file, encoding)
        assert len(list(open_recording(folder))) == 1, folder


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_rigs_settings_scenes_and_banks(tmp_path: Path, encoding: str) -> None:
    rig, toml, settings = tmp_path / "rig.yaml", tmp_path / "s.toml", tmp_path / "s.json"
    rig.write_text(f"reference: c\ncameras: {{c: {{rig_from_camera: {np.eye(4).tolist()}}}}}\n")
    toml.write_text("foreground = 0.7\n")
    settings.write_text('{"foreground": 0.7}')
    scene = make_scene(0, stems=1).save(tmp_path / "scene.json")
    bank = write_bank(tmp_path / "bank", [(make_scene(1, stems=1), "train")], name="b").path
    for file in (rig, toml, settings, scene, *bank.glob("*.json")):
        as_editors_save(file, encoding)
    assert load_mounting(rig).reference == "c"
    for file in (toml, settings):
        assert resolve(ReconstructionSettings(), file).foreground == 0.7
    assert Scene.load(scene).name == "made-up-0"
    assert [each.name for each in SceneBank.open(bank)] == ["made-up-1"]


def test_half_a_text_of_utf_16_is_refused(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_bytes(codecs.BOM_UTF16_LE + "speed = 1".encode("utf-16-le")[:-1])
    with pytest.raises(FileFormatError, match=r"s\.toml: begins as UTF-16"):
        resolve(ReconstructionSettings(), tmp_path / "s.toml")
