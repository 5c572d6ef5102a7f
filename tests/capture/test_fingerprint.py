from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from greenhouse_gym.capture import Camera, Intrinsics, Recording, RgbdFrame, Rig, Station, open_recording
from greenhouse_gym.capture.formats.own import write_recording
from greenhouse_gym.capture.recordings import fingerprint

INTRINSICS = Intrinsics(4, 3, 2.0, 2.0, 1.5, 1.0)


def made(seed: int = 0, stations: int = 3) -> Recording:
    rig = Rig({"c": Camera(INTRINSICS, np.eye(4))}, "c")

    def load(i: int) -> Station:
        color = np.random.default_rng([seed, i]).integers(0, 256, (3, 4, 3), dtype=np.uint8)
        return Station({"c": RgbdFrame(color, np.full((3, 4), 0.5 + 0.1 * i, np.float32), INTRINSICS)})

    return Recording("walk", rig, stations, load)


def greenhouse(folder: Path) -> Path:
    write_recording(made(), folder)
    return folder / "color" / "c" / "000001.png"


def images(folder: Path, color: str) -> Path:
    for kind, image in ((color, np.zeros((3, 4, 3), np.uint8)), ("depth", np.full((3, 4), 500, np.uint16))):
        (folder / kind).mkdir(parents=True)
        for i in range(2):
            (folder / kind / f"{i}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
    return folder / "depth" / "1.png"


def calibrated(folder: Path) -> Path:
    image = images(folder, "rgb")
    matrix = "camera_matrix: [2, 0, 1.5, 0, 2, 1, 0, 0, 1]"
    (folder / "camera_x.yaml").write_text(f"image_width: 4\nimage_height: 3\n{matrix}\n")
    return image


def open3d(folder: Path) -> Path:
    return images(folder, "color")


@pytest.mark.parametrize("make", [greenhouse, calibrated, open3d])
@pytest.mark.parametrize("contents", [True, False])
def test_other_images_make_another_recording(tmp_path: Path, make: Callable[[Path], Path], contents: bool) -> None:
    image = make(tmp_path / "one")
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    first = fingerprint(open_recording(tmp_path / "one"), contents)
    assert fingerprint(open_recording(tmp_path / "one"), contents) == first
    assert fingerprint(open_recording(tmp_path / "two"), contents) == first
    other = tmp_path / "two" / image.relative_to(tmp_path / "one")
    stored = cv2.imread(str(other), cv2.IMREAD_UNCHANGED)
    other.write_bytes(cv2.imencode(".png", stored + 7)[1].tobytes())
    assert fingerprint(open_recording(tmp_path / "two"), contents) != first
    other.unlink()
    gone = fingerprint(open_recording(tmp_path / "two"), contents)
    assert gone != first


def test_a_recording_in_memory_is_identified_by_its_images() -> None:
    assert fingerprint(made()) == fingerprint(made())
    different = [fingerprint(w) for w in (made(), made(seed=1), made(stations=2))]
    moved = Rig({"c": Camera(INTRINSICS, np.diag([1.0, -1.0, -1.0, 1.0]))}, "c")
    different.append(fingerprint(replace(made(), rig=moved)))
    assert len(set(different)) == 4


def test_a_reader_that_names_no_files_has_those_of_its_folder(tmp_path: Path) -> None:
    write_recording(made(), tmp_path)
    recording = replace(open_recording(tmp_path), files=())
    before = fingerprint(recording)
    (tmp_path / "notes.txt").write_text("x")
    assert fingerprint(recording) != before
