"""An interrupted registration resumes from its journal, with the same result."""

from __future__ import annotations

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
from greenhouse_gym.capture.image_files import encode_png
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, reconstruct_row, station_registration
from greenhouse_gym.reconstruction.station_journal import StationJournal

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
def written_journal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Journal of three stations of four."""
    folder = tmp_path_factory.mktemp("written_journal")
    interrupt(folder, 2)
    return folder


@pytest.fixture
def journal(written_journal: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written_journal, tmp_path / "journal"))


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
    """Compare to the last bit, except for the times."""
    for name in ("points", "colors", "normals", "station", "registered", "world_from_station"):
        np.testing.assert_array_equal(getattr(row, name), getattr(expected, name))
    assert replace(row.report, seconds={}) == replace(expected.report, seconds={})


@pytest.mark.parametrize(("after", "error"), [(0, KeyboardInterrupt), (1, RuntimeError), (3, KeyboardInterrupt)])
def test_an_interrupted_registration_resumes_to_the_same_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: int, error: type[BaseException]
) -> None:
    interrupt(tmp_path, after, error=error)
    registered: list[int] = []
    register = station_registration._register_station

    def counted(i: int, *rest: Any) -> Any:
        registered.append(i)
        return register(i, *rest)

    monkeypatch.setattr(station_registration, "_register_station", counted)
    row, _ = resume(tmp_path)
    assert registered == list(range(after + 1, 4))
    assert_same(row, uninterrupted())


def test_a_registration_interrupted_again_and_again(tmp_path: Path) -> None:
    for after in range(4):
        interrupt(tmp_path, after)
    row, read = resume(tmp_path)
    assert read == [0, 3]  # to tell whether it is the same recording
    assert_same(row, uninterrupted())


def test_a_calibrated_registration_resumes_to_the_same_row(tmp_path: Path) -> None:
    calibrated = ReconstructionSettings(calibration_stations=1)
    interrupt(tmp_path, 1, settings=calibrated)
    row, _ = resume(tmp_path, settings=calibrated)
    assert any(row.report.calibration.bias.values())
    assert_same(row, uninterrupted(calibrated))


def test_progress_includes_resumed_stations(journal: Path) -> None:
    reported: list[int] = []
    reconstruct_row(short_recording(), KNOWN, reported.append, journal)
    assert reported == [0, 1, 2, 3]


# -- another recording ------------------------------------------------------------------------------------------------


def test_other_settings_start_again(journal: Path) -> None:
    other = replace(KNOWN, max_rmse=0.002)
    row, read = resume(journal, settings=other)
    assert read == [0, 1, 2, 3]
    assert_same(row, uninterrupted(other))


def test_another_recording_of_the_same_name_starts_again(journal: Path) -> None:
    other = from_stations([half_recording()[i] for i in (1, 2, 3, 4)], half_recording())
    assert resume(journal, other)[1] == [0, 1, 2, 3]


def damage_image(folder: Path) -> None:
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


@pytest.mark.parametrize("change", [damage_image, replace_image_by_one_of_its_size, remove_image, rename_index])
def test_a_changed_recording_starts_again(tmp_path: Path, change: Callable[[Path], None]) -> None:
    recording = from_stations(list(half_recording())[:2], half_recording())
    folder = write_recording(recording, tmp_path / "recording")
    journal = tmp_path / "journal"
    interrupt(journal, 0, open_recording(folder))
    assert len(StationJournal.open(journal, open_recording(folder), KNOWN).entries) == 1
    change(folder)
    assert StationJournal.open(journal, open_recording(folder), KNOWN).entries == []


# -- damaged journals -------------------------------------------------------------------------------------------------


def truncate_file(folder: Path) -> None:
    file = folder / "000002.npz"
    file.write_bytes(file.read_bytes()[:-1000])


def flip_bit(folder: Path) -> None:
    file = folder / "000000.npz"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def remove_file(folder: Path) -> None:
    (folder / "000001.npz").unlink()


def swap_files(folder: Path) -> None:
    one, two = (folder / f"00000{i}.npz" for i in (0, 1))
    content = one.read_bytes()
    one.write_bytes(two.read_bytes())
    two.write_bytes(content)


def change_pose(folder: Path) -> None:
    """The bytes of a pose, as plausible as before."""
    file = folder / "000002.npz"
    pose = np.load(file)["pose 1"]
    moved = pose.copy()
    moved[1, 3] += 0.01
    content = file.read_bytes()
    assert pose.tobytes() in content
    file.write_bytes(content.replace(pose.tobytes(), moved.tobytes()))


def drop_array(folder: Path) -> None:
    file = folder / "000002.npz"
    arrays = dict(np.load(file))
    del arrays["information 1"]
    np.savez(file, **arrays)


def text(folder: Path) -> None:
    (folder / "000001.npz").write_bytes(b"\xff\xfe\x00 null")


def other_arrays(folder: Path) -> None:
    np.savez(folder / "000001.npz", numbers=np.arange(3))


def change_identity(folder: Path) -> None:
    file = folder / "000001.npz"
    np.savez(file, **(dict(np.load(file)) | {"identity": np.array("another")}))


def extra_files(folder: Path) -> None:
    (folder / "000003.npz").write_bytes(b"")
    (folder / "thesis.txt").write_text("mine")


@pytest.mark.parametrize(
    ("damage", "kept"),
    [
        (truncate_file, 2),
        (flip_bit, 0),
        (remove_file, 1),
        (swap_files, 0),
        (change_pose, 2),
        (drop_array, 2),
        (text, 1),
        (other_arrays, 1),
        (change_identity, 1),
        (extra_files, 3),
    ],
)
def test_damaged_journals_are_written_again(journal: Path, damage: Callable[[Path], None], kept: int) -> None:
    damage(journal)
    assert len(StationJournal.open(journal, short_recording(), KNOWN).entries) == kept
    assert_same(resume(journal)[0], uninterrupted())
