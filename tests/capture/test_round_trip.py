"""A simulated recording in the formats of others passes `import` unchanged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from layouts import LAYOUTS, as_described_rig, track_of
from row_helpers import HALF, from_stations, half_recording
from typer.testing import CliRunner

from greenhouse_gym.capture import Recording, open_recording
from greenhouse_gym.capture.rig_file import Mounting, save_mounting
from greenhouse_gym.cli import app

pytest.importorskip("rosbags.highlevel")
from bag_writer import MCAP, write_rig

pytestmark = pytest.mark.xdist_group("row")

RIGS: dict[str, tuple[str, Callable[[Path, Recording], None]]] = {
    "described": ("walk", as_described_rig),
    "bag": ("walk", lambda path, recording: write_rig(path, MCAP, recording)),
}


def imported(folder: Path, source: Path, mounting: Mounting) -> Recording:
    rig = save_mounting(mounting, folder / "rig.yaml")
    command = ["import", str(source), "--rig", str(rig), "--out", str(folder / "out"), "--step", "0"]
    done = CliRunner().invoke(app, command, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return open_recording(folder / "out")


def assert_same(read: Recording, source: Recording, names: dict[str, str]) -> None:
    """Images and poses are those of the source, whose cameras ``names`` gives by the names read."""
    for station, expected in zip(read, source, strict=True):
        for name, camera in names.items():
            np.testing.assert_array_equal(station.frames[name].color, expected.frames[camera].color)
            np.testing.assert_allclose(station.frames[name].depth, expected.frames[camera].depth, atol=1e-6)
        np.testing.assert_allclose(station.world_from_station, expected.world_from_station, atol=1e-6)
    for name, camera in names.items():
        expected_place = source.rig.cameras[camera].rig_from_camera
        np.testing.assert_allclose(read.rig.cameras[name].rig_from_camera, expected_place, atol=1e-8)


def two_stations() -> Recording:
    return from_stations([half_recording()[i] for i in range(2)], half_recording())


@pytest.mark.parametrize("name", RIGS)
def test_three_cameras_come_through(tmp_path: Path, name: str) -> None:
    file, write = RIGS[name]
    write(tmp_path / file, two_stations())
    assert_same(imported(tmp_path, tmp_path / file, Mounting.of(HALF)), two_stations(), {c: c for c in HALF.cameras})


@pytest.mark.parametrize("name", ["tum", "npy of metres"])
def test_one_camera_comes_through(tmp_path: Path, name: str) -> None:
    LAYOUTS[name][1](tmp_path / "walk", track_of(two_stations(), "middle"))
    mounting = Mounting({"camera": HALF.cameras["middle"].rig_from_camera}, "camera")
    assert_same(imported(tmp_path, tmp_path / "walk", mounting), two_stations(), {"camera": "middle"})
