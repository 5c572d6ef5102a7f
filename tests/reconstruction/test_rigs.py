"""Any rig: both directions, portrait and landscape, level and upright beams, one camera or several, any resolution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from row_helpers import HALF, from_stations, half_recording, rendered, worst_errors

from greenhouse_gym.capture import Camera, Intrinsics, Recording, Rig, simulate_recording, three_camera_rig
from greenhouse_gym.capture.simulated import CaptureSettings, perturbed_rig
from greenhouse_gym.crops import grow_row
from greenhouse_gym.errors import ReconstructionError
from greenhouse_gym.geometry import pose, rotation_about, rotation_angle
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, reconstruct_row
from greenhouse_gym.reconstruction.calibration import calibrate
from greenhouse_gym.reconstruction.pair_registration import row_axis

pytestmark = pytest.mark.xdist_group("row")

SMALL = HALF.cameras["middle"].intrinsics
KNOWN = ReconstructionSettings(calibration_stations=0)
QUICK = ReconstructionSettings(calibration_stations=2)


def recording_with(rig: Rig, stations: int = 3, settings: CaptureSettings | None = None) -> Recording:
    return rendered(simulate_recording(grow_row(seed=3, length=0.4), 3, rig, stations, settings))


def both_ways(recording: Recording, metres: float, degrees: float, settings: ReconstructionSettings) -> list[RowCloud]:
    """The recording and the same stations in reverse, all of them registered to within the given errors."""
    rows = []
    for direction in (1, -1):
        way = from_stations(list(recording)[::direction], recording)
        row = reconstruct_row(way, settings)
        assert row.registered.all()
        apart, turned = worst_errors(row, way)
        assert apart < metres
        assert turned < degrees
        assert len(row) > 3000
        rows.append(row)
    return rows


def only(rig: Rig, *names: str) -> Rig:
    return Rig({name: rig.cameras[name] for name in names}, names[-1])


def five_cameras() -> Rig:
    """15 cm apart, each turned 12 degrees more than its neighbor."""
    middle = HALF.cameras["middle"].rig_from_camera
    cameras = {}
    for side in range(-2, 3):
        turn = rotation_about([0, 0, 1], -side * np.deg2rad(12))
        cameras[f"camera {side + 3}"] = Camera(SMALL, pose(turn @ middle[:3, :3], middle[:3, 3] + [0, 0.15 * side, 0]))
    return Rig(cameras, "camera 3")


@pytest.mark.parametrize(("beam", "portrait", "axis"), [
    ("level", True, 0), ("level", False, 1), ("upright", True, 0), ("upright", False, 1),
])  # fmt: skip
def test_both_directions_beams_and_image_axes(beam: str, portrait: bool, axis: int) -> None:
    rig = three_camera_rig(SMALL, beam=beam, portrait=portrait)
    assert row_axis(rig.cameras["middle"]) == axis
    there, back = both_ways(recording_with(rig), 0.006, 0.6, KNOWN)
    assert there.world_from_station[2, 1, 3] > 0.12
    assert back.world_from_station[2, 1, 3] < -0.12
    shifts = [row.report.stations[1].shift_pixels for row in (there, back)]
    assert shifts[0] is not None
    assert shifts[1] is not None
    assert shifts[0] * shifts[1] < 0


def test_a_tripod_moved_to_the_other_side_all_along_the_row() -> None:
    both_ways(half_recording(), 0.008, 0.8, QUICK)


@pytest.mark.parametrize("names", [("middle",), ("last", "middle"), ("last", "first")])
def test_one_and_two_cameras(names: tuple[str, ...]) -> None:
    """Also without a camera that looks straight at the row."""
    for row in both_ways(recording_with(only(HALF, *names)), 0.008, 0.8, KNOWN):
        assert not row.report.warnings


def test_one_camera_is_not_calibrated() -> None:
    row = reconstruct_row(recording_with(only(HALF, "middle"), 2), QUICK)
    assert row.report.calibration.bias == {"middle": 0.0}
    assert row.report.calibration.turned == {}


def test_five_cameras() -> None:
    recording = recording_with(five_cameras(), 2)
    both_ways(recording, 0.005, 0.5, KNOWN)
    _, report = calibrate(recording, replace(QUICK, calibration_stations=1, calibrate_rig=False))
    assert list(report.bias) == list(recording.rig.cameras)
    assert all(report.bias.values())
    assert report.gap_after <= report.gap_before


@pytest.mark.parametrize(("width", "height", "focal"), [(640, 360, 322.0), (640, 480, 385.0), (1280, 720, 640.0)])
def test_other_resolutions(width: int, height: int, focal: float) -> None:
    """Modes of the D435; the others are the 848x480 and 424x240 of the other tests."""
    intrinsics = Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    recording = recording_with(only(three_camera_rig(intrinsics), "middle"), 2)
    row = reconstruct_row(recording, KNOWN)
    assert row.registered.all()
    metres, degrees = worst_errors(row, recording)
    assert metres < 0.005
    assert degrees < 0.4


def test_images_too_coarse_to_register_are_refused_and_not_wrong() -> None:
    """A stereo camera of 212x120 pixels errs by 4 mm at half a metre, nearly the distance ICP looks for partners in."""
    coarse = three_camera_rig(Intrinsics(212, 120, 106.0, 106.0, 105.5, 59.5))
    recording = recording_with(coarse, 2)
    with pytest.raises(ReconstructionError, match="station 1: fitness"):
        reconstruct_row(recording, KNOWN)
    wider = replace(KNOWN, fine_distance=0.012, max_rmse=0.006)
    row = reconstruct_row(recording, wider)
    assert worst_errors(row, recording)[0] < 0.015


def test_cameras_of_different_resolution_on_one_rig() -> None:
    fine = three_camera_rig().cameras["middle"]
    rig = Rig(dict(HALF.cameras) | {"middle": fine}, "middle")
    both_ways(recording_with(rig), 0.006, 0.6, KNOWN)


@pytest.mark.parametrize("degrees", [-10.0, 10.0])
def test_a_rig_that_looks_up_or_down_and_aslant(degrees: float) -> None:
    turn = rotation_about([0.3, 1.0, 0.3], np.deg2rad(degrees))
    head = HALF.cameras["middle"].rig_from_camera[:3, 3]
    about_head = pose(turn, head - turn @ head)
    cameras = {name: Camera(c.intrinsics, about_head @ c.rig_from_camera) for name, c in HALF.cameras.items()}
    both_ways(recording_with(Rig(cameras, "middle")), 0.008, 0.8, KNOWN)


# -- cameras that do not stand where the rig file says ----------------------------------------------------------------

OFF = CaptureSettings(camera_offset=0.005, camera_angle=float(np.deg2rad(1.0)))


def placed_wrong(rig: Rig, actual: Rig) -> tuple[float, float]:
    """By how much the worst camera of a rig stands off where it does: metres, degrees."""
    pairs = [(rig.cameras[name].rig_from_camera, c.rig_from_camera) for name, c in actual.cameras.items()]
    metres = max(float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a, b in pairs)
    radians = max(rotation_angle(a[:3, :3].T @ b[:3, :3]) for a, b in pairs)
    return metres, float(np.degrees(radians))


def test_misplaced_cameras_are_found_and_the_row_comes_out_right() -> None:
    recording = recording_with(HALF, 3, OFF)
    settings = replace(QUICK, calibration_stations=3)
    actual = perturbed_rig(HALF, 3, OFF)
    calibration, report = calibrate(recording, settings)
    assert report.gap_after < 0.8 * report.gap_before
    assert set(report.turned) == set(HALF.cameras)
    before, after = placed_wrong(HALF, actual), placed_wrong(calibration.rig, actual)
    assert after[0] < 0.6 * before[0]
    assert after[1] < 0.4 * before[1]
    row = reconstruct_row(recording, settings)
    assert row.registered.all()
    metres, degrees = worst_errors(row, recording)
    assert metres < 0.006
    assert degrees < 0.6


def test_cameras_that_stand_right_are_left_where_they_are() -> None:
    calibration, report = calibrate(half_recording(), ReconstructionSettings())
    assert report.turned == report.shifted == {}
    assert calibration.rig is half_recording().rig
