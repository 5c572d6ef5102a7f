"""Protocols other than the paper's: what they ask of the reconstruction, and passes joined into one cloud."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from row_helpers import HALF, from_stations, rendered, worst_errors

from greenhouse_gym.build.scenes import BuildSettings, placement_positions
from greenhouse_gym.capture import (
    PROTOCOLS,
    Camera,
    CaptureProtocol,
    Recording,
    Rig,
    join_passes,
    open_recording,
    simulate_protocol,
    simulate_recording,
    three_camera_rig,
    write_recording,
)
from greenhouse_gym.crops import grow_row
from greenhouse_gym.errors import FileFormatError, InvalidValueError, ReconstructionError, UnknownNameError
from greenhouse_gym.reconstruction import ReconstructionSettings, reconstruct_row, settings_for

pytestmark = pytest.mark.xdist_group("row")

SMALL = HALF.cameras["middle"].intrinsics
KNOWN = ReconstructionSettings(calibration_stations=0)


def beam_at(height: float) -> Rig:
    return three_camera_rig(SMALL, height=height)


@cache
def two_passes() -> Recording:
    """Four stations at 1.0 m, and three in a second pass at 1.4 m."""
    row = grow_row(seed=3, length=0.4)
    low = simulate_recording(row, 3, beam_at(1.0))
    high = simulate_recording(row, 3, beam_at(1.4), 3, pass_number=1)
    return rendered(join_passes([low, high]))


def test_the_paper_is_the_default_and_needs_the_papers_settings() -> None:
    assert ReconstructionSettings.of(PROTOCOLS["paper"]) == ReconstructionSettings()
    assert settings_for(half()) == ReconstructionSettings()
    assert settings_for(replace(half(), protocol="paper")) == ReconstructionSettings()


def half() -> Recording:
    return Recording("half", HALF, 0, lambda i: (_ for _ in ()).throw(IndexError(i)))


def test_farther_back_the_cut_moves_and_the_noise_is_given_room() -> None:
    settings = settings_for(replace(half(), protocol="upright-back"))
    assert settings.foreground == pytest.approx(1.0)
    assert settings.fine_distance == pytest.approx(0.008)
    assert settings.max_rmse == pytest.approx(0.004)


def test_an_unknown_protocol_names_the_recording_and_the_choices() -> None:
    with pytest.raises(UnknownNameError, match=r"recording 'half'.*sideways.*upright-back"):
        settings_for(replace(half(), protocol="sideways"))
    with pytest.raises(UnknownNameError, match="paper"):
        simulate_protocol(grow_row(1, 0.1), 1, "sideways")


def test_a_tripod_farther_back_registers_and_says_so_in_its_folder(tmp_path: Path) -> None:
    back = CaptureProtocol("back", "", (three_camera_rig(SMALL, "upright", 0.45, 0.0, 1.3),), back=0.3)
    simulated = simulate_protocol(grow_row(seed=3, length=0.2), 3, back)
    recording = open_recording(write_recording(simulated, tmp_path / "row"))
    assert recording.protocol == "back"
    assert settings_for(recording).foreground == pytest.approx(0.9)
    first = recording[0].world_from_station
    assert first is not None
    assert abs(first[0, 3] + 0.3) < 0.08  # the tilt about the head moves the foot by some centimetres
    row = reconstruct_row(recording, replace(settings_for(recording), calibration_stations=0))
    assert row.registered.all()
    assert worst_errors(row, recording)[0] < 0.015
    assert row.points[:, 0].max() > 0.8


def test_passes_at_two_heights_become_one_cloud() -> None:
    recording = two_passes()
    assert [(one.first, one.lift) for one in recording.passes] == [(0, 0.0), (4, pytest.approx(0.4))]
    row = reconstruct_row(recording, KNOWN)
    assert row.registered.all()
    assert row.report.segments == (tuple(range(7)),)
    assert all(station.segment == 0 for station in row.report.stations)
    metres, degrees = worst_errors(row, recording)
    assert metres < 0.012
    assert degrees < 0.8
    low = reconstruct_row(from_stations([recording[i] for i in range(4)], replace(recording, passes=())), KNOWN)
    assert row.points[:, 2].max() > low.points[:, 2].max() + 0.3
    along = row.world_from_station[:, 1, 3]
    assert placement_positions(along, BuildSettings(spacing=0.1)) == pytest.approx([0.05, 0.15, 0.25], abs=0.03)


def test_passes_are_kept_in_the_recordings_folder(tmp_path: Path) -> None:
    folder = write_recording(two_passes(), tmp_path / "row")
    assert open_recording(folder).passes == two_passes().passes
    index = folder / "recording.json"
    index.write_text(index.read_text().replace('"first": 4', '"first": 40'))
    with pytest.raises(FileFormatError, match="passes must begin at station 0"):
        open_recording(folder)


def test_passes_that_do_not_overlap_are_an_error() -> None:
    low = simulate_recording(grow_row(seed=3, length=0.3), 3, beam_at(1.0))
    elsewhere = simulate_recording(grow_row(seed=5, length=0.3), 3, beam_at(1.2), pass_number=1)
    with pytest.raises(ReconstructionError, match=r"pass 1 overlaps with no pass before it\. station 3 to "):
        reconstruct_row(rendered(join_passes([low, elsewhere])), KNOWN)


def test_only_passes_of_one_rig_are_joined() -> None:
    row = grow_row(seed=3, length=0.2)
    low = simulate_recording(row, 3, beam_at(1.0))
    with pytest.raises(InvalidValueError, match="at least one"):
        join_passes([])
    with pytest.raises(InvalidValueError, match="intrinsics"):
        join_passes([low, simulate_recording(row, 3, three_camera_rig())])
    with pytest.raises(InvalidValueError, match="differ only in their height"):
        join_passes([low, simulate_recording(row, 3, three_camera_rig(SMALL, inward=0.1))])
    alone = Rig({"middle": Camera(SMALL, HALF.cameras["middle"].rig_from_camera)}, "middle")
    with pytest.raises(InvalidValueError, match="the same reference"):
        join_passes([low, simulate_recording(row, 3, alone)])


def test_another_pass_has_other_steps_and_the_same_cameras() -> None:
    row = grow_row(seed=3, length=0.2)
    first, second = (simulate_recording(row, 3, HALF, pass_number=k) for k in range(2))
    a, b = first[1].world_from_station, second[1].world_from_station
    assert a is not None
    assert b is not None
    assert not np.allclose(a, b)
    assert first.rig is second.rig
