from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from greenhouse_gym.capture import Intrinsics, Recording, open_recording, recording_formats, single_camera
from greenhouse_gym.capture.formats import ENTRY_POINTS, registry
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError

INTRINSICS = Intrinsics(4, 3, 2.0, 2.0, 1.5, 1.0)


def write_images(folder: Path, color: str = "rgb", depth: str = "depth") -> Path:
    for kind, image in ((color, np.zeros((3, 4, 3), np.uint8)), (depth, np.full((3, 4), 500, np.uint16))):
        (folder / kind).mkdir(parents=True)
        for i in range(2):
            (folder / kind / f"{i}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
    return folder


def mine(**changes: Any) -> SimpleNamespace:
    """A stranger's format: folders with a file called mine.txt."""

    def open_it(path: Path) -> Recording:
        return single_camera(path, INTRINSICS, sorted(path.glob("rgb/*")), sorted(path.glob("depth/*")))

    parts = {"name": "mine", "description": "mine.txt", "recognizes": lambda path: (path / "mine.txt").exists()}
    return SimpleNamespace(**parts | {"open": open_it} | changes)


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes formats known as an installed package would, until the test ends."""

    def install(**modules: object) -> None:
        import sys

        for name, module in modules.items():
            monkeypatch.setitem(sys.modules, f"stranger_{name}", module)
        found = [EntryPoint(name, f"stranger_{name}", ENTRY_POINTS) for name in modules]
        monkeypatch.setattr(registry, "entry_points", lambda group: found if group == ENTRY_POINTS else [])
        recording_formats.cache_clear()

    yield install
    recording_formats.cache_clear()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (write_images(tmp_path / "recording") / "mine.txt").touch()
    return tmp_path / "recording"


OWN = ["greenhouse", "calibrated", "open3d", "tum", "scannet", "bop", "described", "bag"]


def test_the_package_knows_its_formats() -> None:
    formats = recording_formats()
    assert list(formats)[: len(OWN)] == OWN
    assert all(known.description for known in formats.values())


def test_a_folder_that_only_looks_alike_is_not_claimed(tmp_path: Path) -> None:
    with pytest.raises(
        FileFormatError, match=r"not a recording of a known format \(greenhouse: .*calibrated: .*open3d"
    ):
        open_recording(write_images(tmp_path / "r"))
    with pytest.raises(FileFormatError, match=r"camera_\*\.yaml: cannot be read"):
        open_recording(tmp_path / "r", format="calibrated")


def test_an_object_can_be_the_format(folder: Path) -> None:
    recording = open_recording(folder, format=mine())
    assert len(recording) == 2
    assert recording[1].frames["camera"].depth[0, 0] == np.float32(0.5)


def test_a_package_can_bring_a_format(folder: Path, installed: Any) -> None:
    installed(mine=mine())
    assert list(recording_formats())[len(OWN) :] == ["mine"]
    assert len(open_recording(folder)) == len(open_recording(folder, format="mine")) == 2


def test_two_formats_that_recognize_one_folder_are_reported(folder: Path, installed: Any) -> None:
    installed(mine=mine(), yours=mine(name="yours"))
    with pytest.raises(FileFormatError, match="several formats recognize it: mine, yours; choose one"):
        open_recording(folder)
    assert len(open_recording(folder, format="yours")) == 2


def test_unknown_formats_list_the_choices(folder: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"recording format 'open-3d'.*greenhouse, calibrated, open3d"):
        open_recording(folder, format="open-3d")
    with pytest.raises(InvalidValueError, match="no recording format: it lacks description, recognizes, open"):
        open_recording(folder, format=SimpleNamespace(name="x"))  # type: ignore[arg-type]


@pytest.mark.parametrize("module", [SimpleNamespace(name="x"), mine(name="open3d")])
def test_a_package_with_a_broken_format_is_named(folder: Path, installed: Any, module: object) -> None:
    installed(broken=module)
    with pytest.raises(InvalidValueError, match=r"entry point 'broken' \(stranger_broken\).*(lacks|open3d)"):
        open_recording(folder)


def fail(*_: object) -> Any:
    raise RuntimeError("the cable is loose")


@pytest.mark.parametrize("part", ["recognizes", "open"])
def test_a_reader_that_raises_is_named(folder: Path, installed: Any, part: str) -> None:
    installed(mine=mine(**{part: fail}))
    with pytest.raises(FileFormatError, match=r"recording: .*format 'mine': the cable is loose"):
        open_recording(folder)


@pytest.mark.parametrize("result", [None, [], Recording("empty", None, 0, fail)])  # type: ignore[arg-type]
def test_a_reader_that_finds_nothing_is_named(folder: Path, result: object) -> None:
    with pytest.raises(FileFormatError, match="the format 'mine' found no stations in it"):
        open_recording(folder, format=mine(open=lambda path: result))


def test_a_reader_that_raises_half_way_is_located(folder: Path) -> None:
    whole = open_recording(folder, format=mine())

    def open_it(path: Path) -> Recording:
        return Recording("half", whole.rig, 2, lambda i: whole[0] if i == 0 else fail(), path)

    recording = open_recording(folder, format=mine(open=open_it))
    assert recording[0].frames["camera"].depth.any()
    with pytest.raises(FileFormatError, match=r"recording, station 1: .*format 'mine': the cable is loose"):
        recording[1]


@pytest.mark.parametrize("station", [None, SimpleNamespace(frames={}), SimpleNamespace(frames={"camera": 1})])
def test_a_reader_that_gives_no_stations_is_reported(folder: Path, station: object) -> None:
    whole = open_recording(folder, format=mine())

    def open_it(path: Path) -> Recording:
        return Recording("odd", whole.rig, 1, lambda i: station, path)  # type: ignore[arg-type, return-value]

    with pytest.raises(FileFormatError, match=r"station 0: .*expected a frame of each camera"):
        open_recording(folder, format=mine(open=open_it))[0]
