"""The arm's wrist camera looks before it reaches: its rig, and its images joined with the scan."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
from conftest import make_scene
from row_helpers import HALF, rendered

from greenhouse_gym.accuracy import distance_to_surface
from greenhouse_gym.capture import Recording, Station, simulate_recording
from greenhouse_gym.capture.simulated import photograph
from greenhouse_gym.crops import grow_row
from greenhouse_gym.errors import InvalidValueError, ReconstructionError
from greenhouse_gym.geometry import invert, pose, rotation_about, rotation_angle, transform
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, add_looks, reconstruct_row
from greenhouse_gym.reconstruction import looks as module
from greenhouse_gym.reconstruction.fattening import Fattening
from greenhouse_gym.reconstruction.seen import carve
from greenhouse_gym.reconstruction.views import Calibration, StationView, view_station
from greenhouse_gym.robots import ROBOTS, get_robot, load_robot
from greenhouse_gym.scene import compile_scene
from greenhouse_gym.scene.occupancy import UNKNOWN
from greenhouse_gym.wrist import look_rig

pytestmark = pytest.mark.xdist_group("row")

SMALL = HALF.cameras["middle"].intrinsics
KNOWN = ReconstructionSettings(calibration_stations=0)
STAND = pose(translation=[-0.1, 0.1, 0.0])
"""Where the arm is meant to stand in the row's true frame: 0.6 m from the stems."""


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_the_arm_looks_at_the_plants_without_touching_any(name: str) -> None:
    robot = get_robot(name)
    rig = look_rig(robot)
    assert len(rig.cameras) == 5
    compiled = compile_scene(make_scene(0), robot)
    model, data = compiled.model, mujoco.MjData(compiled.model)
    for k, camera in enumerate(rig.cameras.values()):
        assert camera.rig_from_camera[0, 2] > 0.9  # looks along x
        assert 0.9 < camera.rig_from_camera[2, 3] < 1.9
        data.qpos[:] = robot.starts[f"look_{k}"]
        mujoco.mj_forward(model, data)
        assert data.ncon == 0
        tip = data.site_xpos[compiled.tip_site]
        assert np.linalg.norm(tip - camera.rig_from_camera[:3, 3]) == pytest.approx(np.hypot(0.07, 0.13), abs=1e-6)


def test_an_arm_that_knows_no_looks_needs_them_given() -> None:
    robot = load_robot(get_robot("ur5e").path)
    assert len(look_rig(robot, [robot.start]).cameras) == 1
    with pytest.raises(InvalidValueError, match=r"\(k, 6\)"):
        look_rig(robot, [[0.0, 0.0]])


@cache
def scanned() -> tuple[Recording, RowCloud]:
    recording = rendered(simulate_recording(grow_row(seed=3, length=0.2), 3, HALF))
    return recording, reconstruct_row(recording, KNOWN)


@cache
def looks() -> Recording:
    """The arm is put up a centimetre and half a degree from where it is meant to stand."""
    actual = STAND @ pose(rotation_about([0, 0, 1], 0.01), [0.006, -0.007, 0.004])
    return rendered(
        photograph(grow_row(seed=3, length=0.2), 3, look_rig(intrinsics=SMALL), actual[None], walk_number=1)
    )


def test_what_the_arm_sees_joins_the_cloud_where_it_belongs() -> None:
    recording, row = scanned()
    first, actual = recording[0].world_from_station, looks()[0].world_from_station
    assert first is not None
    assert actual is not None
    whole, found = add_looks(row, recording, looks(), (invert(first) @ STAND)[None], KNOWN)
    off = invert(found[0]) @ invert(first) @ actual
    assert np.linalg.norm(transform(off, np.array([[0.5, 0.0, 1.1]]))[0] - [0.5, 0.0, 1.1]) < 0.006
    assert rotation_angle(off[:3, :3]) < 0.008
    assert (whole.points[: len(row)] == row.points).all()
    new = whole.points[len(row) :]
    assert len(new) > 2000
    assert new[:, 2].max() > row.points[:, 2].max() + 0.1
    assert np.percentile(distance_to_surface(transform(first, new), grow_row(seed=3, length=0.2)), 90) < 0.012
    assert len(whole.station) == len(whole) == whole.report.points
    corners = invert(first)[:3, 3] + [[0.0, -0.2, 0.2], [0.5, 0.4, 2.2]]
    before, after = (carve(cloud, np.eye(4), *corners).states != UNKNOWN for cloud in (row, whole))
    assert (after | ~before).all()
    assert after.mean() > 1.6 * before.mean()


def test_edges_of_what_the_arm_saw_are_thinned_by_what_its_own_camera_tells(monkeypatch: pytest.MonkeyPatch) -> None:
    recording, row = scanned()
    thinned: dict[int, Fattening] = {}

    def view(station: Station, calibration: Calibration, settings: ReconstructionSettings) -> StationView:
        thinned[len(calibration.rig.cameras)] = calibration.fattening
        # images this small would lose too much by it to be registered
        return view_station(station, replace(calibration, fattening=Fattening()), settings)

    monkeypatch.setattr(module, "fattening_of", lambda stations, settings: Fattening(1, 0))
    monkeypatch.setattr(module, "view_station", view)
    first = recording[0].world_from_station
    assert first is not None
    add_looks(row, recording, looks(), (invert(first) @ STAND)[None], KNOWN)
    own, arm = len(recording.rig.cameras), len(looks().rig.cameras)
    assert thinned == {own: row.report.calibration.fattening, arm: Fattening(1, 0)}


def test_looks_that_fit_nothing_or_stand_nowhere_are_errors() -> None:
    recording, row = scanned()
    with pytest.raises(InvalidValueError, match=r"\(4, 4\) pose of the arm's stand for each of 1 stands"):
        add_looks(row, recording, looks(), np.full((1, 4, 4), np.nan), KNOWN)
    with pytest.raises(InvalidValueError, match="shape"):
        add_looks(row, recording, looks(), np.eye(4), KNOWN)
    with pytest.raises(ReconstructionError, match="stand 0 fits no station near it"):
        add_looks(row, recording, looks(), pose(translation=[-0.1, 0.4, 0.0])[None], KNOWN)
