"""The recorder: stations taken, faults reported, and what remains of an interrupted recording."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from walls import STEP, frame, video

from greenhouse_gym.capture import RgbdFrame, Station, open_recording
from greenhouse_gym.capture.realsense import synchronized
from greenhouse_gym.capture.recorder import PREVIEW, RecordedStation, record
from greenhouse_gym.cli.recording_commands import Keys
from greenhouse_gym.errors import CameraError, FileFormatError

RIG = video().rig


def moments(count: int = 30, blurred: int = 0, fail: BaseException | None = None) -> Iterator[Station]:
    """A wall that goes by at 2 cm a moment, the one ``blurred`` out of focus; then perhaps something happens."""
    for i in range(count):
        yield Station({"camera": frame(i, blurred=bool(blurred) and i == blurred)})
    if fail:
        raise fail


def test_stations_are_taken_by_themselves_every_ten_centimetres(tmp_path: Path) -> None:
    taken: list[RecordedStation] = []
    count = record(moments(), RIG, tmp_path / "row", 0.10, on_station=taken.append)
    assert count == len(open_recording(tmp_path / "row")) == len(taken)
    assert count in (5, 6)
    assert taken[0].moved is None
    for one in taken[1:]:
        assert one.moved == pytest.approx(0.10, abs=STEP)
        assert not one.faults
    first = open_recording(tmp_path / "row")[0].frames["camera"]
    np.testing.assert_array_equal(first.color, frame(0).color)
    image = cv2.imread(str(tmp_path / "row" / PREVIEW))
    assert image.shape[:2] == (120, 160)


def test_a_blurred_moment_is_passed_over(tmp_path: Path) -> None:
    record(moments(8, blurred=5), RIG, tmp_path / "row", 0.10)
    second = open_recording(tmp_path / "row")[1].frames["camera"]
    np.testing.assert_array_equal(second.color, frame(6).color)


def test_stations_are_taken_when_asked_for(tmp_path: Path) -> None:
    answers = iter([False, True, False, True, False])
    assert record(moments(5), RIG, tmp_path / "row", 0.0, requested=lambda: next(answers)) == 2
    found = open_recording(tmp_path / "row")
    for station, i in zip(found, (1, 3), strict=True):
        np.testing.assert_array_equal(station.frames["camera"].color, frame(i).color)


@pytest.mark.parametrize("fail", [KeyboardInterrupt(), CameraError("the cable is loose")])
def test_what_was_written_stays_when_it_is_cut_short(tmp_path: Path, fail: BaseException) -> None:
    with pytest.raises(type(fail)):
        record(moments(12, fail=fail), RIG, tmp_path / "row")
    assert len(open_recording(tmp_path / "row")) == 2 + (STEP * 11 > 0.2)
    with pytest.raises(FileFormatError, match="already holds a recording"):
        record(moments(2), RIG, tmp_path / "row")


def test_a_disk_that_fails_in_the_middle_of_a_station_leaves_those_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from greenhouse_gym.capture.formats import own

    real = own.write_atomically

    def full(path: Path, content: bytes | str) -> Path:
        if path.name == "000001.png" and "depth" in path.parts:
            raise OSError("no space left on device")
        return real(path, content)

    monkeypatch.setattr(own, "write_atomically", full)
    with pytest.raises(OSError, match="no space"):
        record(moments(), RIG, tmp_path / "row")
    assert len(open_recording(tmp_path / "row")) == 1
    assert open_recording(tmp_path / "row")[0].frames["camera"].depth.any()


def test_faults_are_reported_at_once(tmp_path: Path) -> None:
    taken: list[RecordedStation] = []
    dark = (Station({"camera": frame(0, gray=0.1)}) for _ in range(2))
    record(dark, RIG, tmp_path / "dark", on_station=taken.append)
    assert any("too dark" in fault for fault in taken[0].faults)
    taken.clear()
    far = (Station({"camera": frame(0, distance=2.5)}) for _ in range(2))
    record(far, RIG, tmp_path / "far", on_station=taken.append)
    assert any("almost nothing" in fault for fault in taken[0].faults)


# -- several cameras --------------------------------------------------------------------------------------------------


def stream(times: list[float]) -> Iterator[tuple[float, RgbdFrame]]:
    return ((time, frame(i)) for i, time in enumerate(times))


def test_images_without_a_partner_are_passed_over() -> None:
    left, right = [0.0, 0.033, 0.066, 0.1], [0.004, 0.070, 0.104]
    found = list(synchronized({"left": stream(left), "right": stream(right)}))
    assert len(found) == 3
    np.testing.assert_array_equal(found[1]["left"].color, frame(2).color)
    np.testing.assert_array_equal(found[1]["right"].color, frame(1).color)


def test_clocks_that_differ_are_reported() -> None:
    left, right = (0.01 * i for i in range(2000)), (100.0 + 0.01 * i for i in range(2000))
    one = frame(0)
    streams = {name: ((time, one) for time in times) for name, times in (("left", left), ("right", right))}
    with pytest.raises(CameraError, match=r"'left' are 9.* s behind: its clock differs"):
        next(synchronized(streams))


def test_keys_ask_for_stations_and_for_the_end() -> None:
    keys = Keys(io.StringIO("\n\nq\n"))
    while keys._lines.qsize() < 3:
        pass
    assert list(keys.until_end(moments(3))) == []
    assert [keys.pressed() for _ in range(3)] == [True, True, False]
