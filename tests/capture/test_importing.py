"""Videos become stations, and recordings get a verdict in words."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from row_helpers import from_stations, half_recording
from typer.testing import CliRunner
from walls import STEP, frame, video

from greenhouse_gym.capture import RgbdFrame, Station, open_recording, write_recording
from greenhouse_gym.capture.inspection import inspect_recording
from greenhouse_gym.capture.station_selection import choose_stations, motion
from greenhouse_gym.cli import app


def test_a_motion_is_measured_on_images() -> None:
    assert motion(frame(0), frame(2)) == pytest.approx(0.04, abs=0.002)
    assert motion(frame(0), frame(0)) == pytest.approx(0.0, abs=1e-4)
    assert motion(frame(0, gray=0.0), frame(1)) is None


def test_stations_are_ten_centimetres_apart_and_sharp() -> None:
    found = choose_stations(video(), 0.10)
    assert found.path[-1] == pytest.approx(39 * STEP, rel=0.05)
    steps = np.diff(np.array(found.frames)) * STEP
    assert len(found.frames) in (8, 9)
    assert np.all((steps > 0.05) & (steps < 0.15))
    assert all(i % 5 or i == 0 for i in found.frames)


def test_few_frames_of_a_slow_video_are_read() -> None:
    seen: list[int] = []

    def load(i: int) -> Station:
        seen.append(i)
        return Station({"camera": frame(i / 10)})  # 2 mm a frame

    found = choose_stations(replace(video(), size=200, load=load), 0.10)
    assert found.path[-1] == pytest.approx(0.4, rel=0.05)
    assert np.allclose(np.array(found.frames) * 0.002, 0.1 * np.arange(len(found.frames)), atol=0.03)
    assert len(set(seen)) < 100


def test_a_video_without_motion_has_one_station_and_a_damaged_frame_is_left_out() -> None:
    assert len(choose_stations(video(20, still=True)).frames) == 1
    found = choose_stations(video(20, unreadable=10))
    assert found.unreadable == (10,)
    assert 10 not in found.frames


STATIONS = replace(video(), size=6, load=lambda i: Station({"camera": frame(5 * i + 1)}))


def test_a_good_recording_is_called_good() -> None:
    found = inspect_recording(STATIONS)
    assert found.good_for_registration
    assert not found.good_for_small_fruit
    assert "a pixel of camera camera is 2.4 mm wide" in found.verdict[1]
    assert np.median(found.steps) == pytest.approx(0.10, abs=0.01)
    assert found.overlap == pytest.approx(1 - 0.1 / (0.6 * 240 / 250), abs=0.05)
    assert sum(found.histogram) == pytest.approx(1.0)


FAULTS = {
    "too dark": video(6, gray=0.15),
    "overexposed": video(6, gray=30.0),
    "almost nothing": video(6, distance=2.5),
    "hardly moves": video(6, still=True),
    "share": replace(video(), size=4, load=lambda i: Station({"camera": frame(15 * i + 1)})),
}


@pytest.mark.parametrize("what", FAULTS)
def test_faults_are_reported(what: str) -> None:
    found = inspect_recording(FAULTS[what])
    assert not found.good_for_registration
    assert what in found.verdict[0]


def test_a_single_station_is_not_good_enough() -> None:
    found = inspect_recording(replace(STATIONS, size=1))
    assert not found.good_for_registration
    assert "single station" in found.verdict[0]


def turned(station: Station, *names: str) -> Station:
    """The station with the images of some cameras upside down."""
    return Station(
        {
            name: RgbdFrame(frame.color[::-1, ::-1], frame.depth[::-1, ::-1], frame.intrinsics)
            if name in names
            else frame
            for name, frame in station.frames.items()
        }
    )


def swapped(station: Station, one: str, other: str) -> Station:
    names = {one: other, other: one}
    return Station({name: station.frames[names.get(name, name)] for name in station.frames})


LAST_TURNED = "the images of camera last seem to be upside down"
ALL_TURNED = (
    "the cameras first and last seem to be swapped, or all images seem to be upside down"  # the rig is symmetric
)
MISTAKES = {
    LAST_TURNED: lambda station: turned(station, "last"),
    ALL_TURNED: lambda station: turned(station, "first", "middle", "last"),
    "the cameras first and middle seem to be swapped": lambda station: swapped(station, "first", "middle"),
}


@pytest.mark.xdist_group("row")
@pytest.mark.parametrize("said", ["", *MISTAKES])
def test_swapped_cameras_and_images_upside_down_are_noticed(said: str) -> None:
    recording = half_recording()
    mistake = MISTAKES.get(said, lambda station: station)
    verdict = inspect_recording(from_stations([mistake(recording[i]) for i in range(2)], recording)).verdict[0]
    assert f"the rig does not fit the images: {said}; turn" in verdict if said else "does not fit" not in verdict


def test_import_writes_a_recording_a_report_and_a_picture(tmp_path: Path) -> None:
    write_recording(video(12), tmp_path / "video")
    done = CliRunner().invoke(app, ["import", str(tmp_path / "video"), "--out", str(tmp_path / "walk")])
    assert done.exit_code == 0, done.output
    assert "good enough for registration" in done.output
    assert 2 <= len(open_recording(tmp_path / "walk")) <= 4
    report = json.loads((tmp_path / "walk" / "import.json").read_text())
    assert report["good_for_registration"]
    assert report["cameras"]["camera"]["distance"] == pytest.approx(0.6, abs=0.01)
    picture = tmp_path / "walk" / "import.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    picture.unlink()  # as if it had been killed before the picture, which is the last file
    for code in (0, 1):
        again = CliRunner().invoke(app, ["import", str(tmp_path / "video"), "--out", str(tmp_path / "walk")])
        assert again.exit_code == code
        assert picture.exists()
        assert json.loads((tmp_path / "walk" / "import.json").read_text()) == report
    every = CliRunner().invoke(app, ["import", str(tmp_path / "video"), "--out", str(tmp_path / "all"), "--step", "0"])
    assert every.exit_code == 0
    assert len(open_recording(tmp_path / "all")) == 12
