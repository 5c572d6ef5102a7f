"""A walk that was interrupted goes on from its notes, and ends as if nothing had happened."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from row_helpers import from_stations, half_recording

from greenhouse_gym.capture import Recording, Station, open_recording, write_recording
from greenhouse_gym.capture.images import encode_png
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, reconstruct_row, walk
from greenhouse_gym.reconstruction.diary import Diary, Entry

pytestmark = pytest.mark.xdist_group("row")

KNOWN = ReconstructionSettings(calibration_stations=0)


@cache
def short_recording() -> Recording:
    return from_stations(list(half_recording())[:4], half_recording())


@cache
def uninterrupted(settings: ReconstructionSettings = KNOWN) -> RowCloud:
    return reconstruct_row(short_recording(), settings)


def interrupt(
    folder: Path,
    after: int,
    recording: Recording | None = None,
    settings: ReconstructionSettings = KNOWN,
    error: type[BaseException] = KeyboardInterrupt,
) -> None:
    """Reconstruct, but stop when station ``after`` is done."""

    def stop(i: int) -> None:
        if i == after:
            raise error

    with pytest.raises(error):
        reconstruct_row(recording or short_recording(), settings, stop, folder)


@pytest.fixture(scope="module")
def noted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Notes of three stations of four."""
    folder = tmp_path_factory.mktemp("noted")
    interrupt(folder, 2)
    return folder


@pytest.fixture
def notes(noted: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(noted, tmp_path / "notes"))


def resume(
    folder: Path, recording: Recording | None = None, settings: ReconstructionSettings = KNOWN
) -> tuple[RowCloud, list[int]]:
    """The row, and the stations that were read on the way."""
    recording = recording or short_recording()
    read: list[int] = []

    def load(i: int) -> Station:
        read.append(i)
        return recording.load(i)

    row = reconstruct_row(replace(recording, load=load), settings, folder=folder)
    return row, sorted(set(read))


def assert_same(row: RowCloud, expected: RowCloud) -> None:
    """To the last bit, but for the times it took."""
    for name in ("points", "colors", "normals", "station", "registered", "world_from_station"):
        np.testing.assert_array_equal(getattr(row, name), getattr(expected, name))
    assert replace(row.report, seconds={}) == replace(expected.report, seconds={})


@pytest.mark.parametrize(("after", "error"), [(0, KeyboardInterrupt), (1, RuntimeError), (3, KeyboardInterrupt)])
def test_an_interrupted_walk_goes_on_to_the_same_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: int, error: type[BaseException]
) -> None:
    interrupt(tmp_path, after, error=error)
    placed: list[int] = []
    place = walk._place

    def counted(i: int, *rest: Any) -> Entry:
        placed.append(i)
        return place(i, *rest)

    monkeypatch.setattr(walk, "_place", counted)
    row, _ = resume(tmp_path)
    assert placed == list(range(after + 1, 4))
    assert_same(row, uninterrupted())


def test_a_walk_interrupted_again_and_again(tmp_path: Path) -> None:
    for after in range(4):
        interrupt(tmp_path, after)
    row, read = resume(tmp_path)
    assert read == [0, 3]  # to tell whether it is the same recording
    assert_same(row, uninterrupted())


def test_a_calibrated_walk_goes_on_to_the_same_row(tmp_path: Path) -> None:
    calibrated = ReconstructionSettings(calibration_stations=1)
    interrupt(tmp_path, 1, settings=calibrated)
    row, _ = resume(tmp_path, settings=calibrated)
    assert any(row.report.calibration.bias.values())
    assert_same(row, uninterrupted(calibrated))


def test_progress_is_told_for_what_was_noted_too(notes: Path) -> None:
    told: list[int] = []
    reconstruct_row(short_recording(), KNOWN, told.append, notes)
    assert told == [0, 1, 2, 3]


# -- another walk -----------------------------------------------------------------------------------------------------


def test_other_settings_begin_anew(notes: Path) -> None:
    other = replace(KNOWN, samples=4000)
    row, read = resume(notes, settings=other)
    assert read == [0, 1, 2, 3]
    assert_same(row, uninterrupted(other))


def test_another_recording_of_the_same_name_begins_anew(notes: Path) -> None:
    other = from_stations([half_recording()[i] for i in (1, 2, 3, 4)], half_recording())
    assert resume(notes, other)[1] == [0, 1, 2, 3]


def spoil_image(folder: Path) -> None:
    (folder / "depth" / "middle" / "000001.png").write_bytes(encode_png(np.zeros((240, 424), dtype=np.uint16)))


def replace_image_by_one_of_its_size(folder: Path) -> None:
    file = folder / "depth" / "middle" / "000001.png"
    before = file.stat()
    file.write_bytes(file.read_bytes()[::-1])
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns + 1_000_000))
    assert file.stat().st_size == before.st_size


def remove_image(folder: Path) -> None:
    (folder / "depth" / "middle" / "000001.png").unlink()


def rename_index(folder: Path) -> None:
    index = folder / "recording.json"
    index.write_text(index.read_text().replace('"name": "simulated-1"', '"name": "another"'))


@pytest.mark.parametrize("change", [spoil_image, replace_image_by_one_of_its_size, remove_image, rename_index])
def test_a_changed_recording_begins_anew(tmp_path: Path, change: Callable[[Path], None]) -> None:
    recording = from_stations(list(half_recording())[:2], half_recording())
    folder = write_recording(recording, tmp_path / "recording")
    notes = tmp_path / "notes"
    interrupt(notes, 0, open_recording(folder))
    assert len(Diary.open(notes, open_recording(folder), KNOWN).entries) == 1
    change(folder)
    assert Diary.open(notes, open_recording(folder), KNOWN).entries == []


# -- spoiled notes ----------------------------------------------------------------------------------------------------


def lines(folder: Path) -> list[str]:
    return (folder / "walk.jsonl").read_text().splitlines()


def write(folder: Path, content: list[str]) -> None:
    (folder / "walk.jsonl").write_text("\n".join(content) + "\n")


def truncate_line(folder: Path) -> None:
    log = folder / "walk.jsonl"
    log.write_bytes(log.read_bytes()[:-200])


def change_pose(folder: Path) -> None:
    """As plausible as before, but not what was found."""
    *others, last = lines(folder)
    line = json.loads(last)
    line["edges"]["1"][0][1][3] += 0.01
    write(folder, [*others, json.dumps(line)])


def no_text(folder: Path) -> None:
    log = folder / "walk.jsonl"
    log.write_bytes(log.read_bytes() + b"\xff\xfe\x00")


def drop_line(folder: Path) -> None:
    content = lines(folder)
    write(folder, [*content[:2], *content[3:]])


def other_json(folder: Path) -> None:
    write(folder, [*lines(folder), "[1, 2]", "7", "null", "{}"])


def change_header(folder: Path) -> None:
    write(folder, ["{}", *lines(folder)[1:]])


def no_log(folder: Path) -> None:
    (folder / "walk.jsonl").unlink()


def no_cloud(folder: Path) -> None:
    (folder / "000001.npz").unlink()


def truncate_cloud(folder: Path) -> None:
    file = folder / "000002.npz"
    file.write_bytes(file.read_bytes()[:-1000])


def flip_cloud(folder: Path) -> None:
    file = folder / "000000.npz"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def swap_clouds(folder: Path) -> None:
    one, two = (folder / f"00000{i}.npz" for i in (0, 1))
    content = one.read_bytes()
    one.write_bytes(two.read_bytes())
    two.write_bytes(content)


@pytest.mark.parametrize(
    ("spoil", "kept"),
    [
        (truncate_line, 2), (change_pose, 2), (no_text, 3), (drop_line, 1), (other_json, 3), (change_header, 0),
        (no_log, 0), (no_cloud, 1), (truncate_cloud, 2), (flip_cloud, 0), (swap_clouds, 0),
    ],
)  # fmt: skip
def test_spoiled_notes_are_made_again(notes: Path, spoil: Callable[[Path], None], kept: int) -> None:
    spoil(notes)
    assert len(Diary.open(notes, short_recording(), KNOWN).entries) == kept
    assert_same(resume(notes)[0], uninterrupted())
