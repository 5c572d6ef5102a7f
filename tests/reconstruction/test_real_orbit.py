"""Real frames outside the method's motion: an orbit around a nearly empty table, where nothing wrong may be accepted.

The recording is looked for in the folder that the environment variable GREENHOUSE_GYM_REAL_DATA names.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from greenhouse_gym.capture import Recording, open_recording
from greenhouse_gym.errors import ReconstructionError
from greenhouse_gym.geometry import Array, invert, rotation_angle
from greenhouse_gym.reconstruction import ReconstructionSettings, pair_registration, settings_for
from greenhouse_gym.reconstruction.icp import fine_icp
from greenhouse_gym.reconstruction.pair_registration import Registration, alignment_problem, register_pair
from greenhouse_gym.reconstruction.station_registration import register_stations
from greenhouse_gym.reconstruction.station_views import Calibration, StationView, station_view

FOLDER = Path(os.environ.get("GREENHOUSE_GYM_REAL_DATA", "/nonexistent"))
pytestmark = [
    pytest.mark.skipif(not FOLDER.is_dir(), reason="GREENHOUSE_GYM_REAL_DATA names no folder with real recordings"),
    pytest.mark.xdist_group("orbit"),
]

CUT = ReconstructionSettings()
CREDULOUS = replace(
    CUT,
    min_fitness=0.3,
    min_overlap=0.0,
    max_contradicted=1.0,
    step_range=(0.0, 0.5),
    max_rotation=3.0,
    max_sideways=0.5,
)
"""Settings that take nearly any motion for true."""


@cache
def orbit() -> Recording:
    """Its first four stations."""
    recording = open_recording(FOLDER / "d435_table")
    stations = [recording[i] for i in range(4)]
    return replace(recording, size=len(stations), load=stations.__getitem__, folder=None)


@cache
def view(i: int, foreground: float) -> StationView:
    return station_view(orbit()[i], Calibration(orbit().rig), replace(CUT, foreground=foreground))


def true_motion(first: int, second: int) -> Array:
    poses = [orbit()[i].world_from_station for i in (first, second)]
    assert poses[0] is not None
    assert poses[1] is not None
    return np.asarray(invert(poses[0]) @ poses[1])


def is_wrong(found: Array, true: Array) -> bool:
    """The poses themselves are known to some millimetres."""
    return bool(
        np.linalg.norm(found[:3, 3] - true[:3, 3]) > 0.02
        or np.degrees(rotation_angle(found[:3, :3].T @ true[:3, :3])) > 2
    )


def registrations(settings: ReconstructionSettings, steps: int = 1) -> Mapping[tuple[int, int], Registration]:
    """Of stations ``steps`` apart."""
    return {
        (i, i + steps): register_pair(
            view(i, settings.foreground), view(i + steps, settings.foreground), steps, settings
        )
        for i in range(len(orbit()) - steps)
    }


def wrong_ones(motions: Mapping[tuple[int, int], Array]) -> list[tuple[int, int]]:
    return [pair for pair, motion in motions.items() if is_wrong(motion, true_motion(*pair))]


def accepted(found: Mapping[tuple[int, int], Registration]) -> dict[tuple[int, int], Array]:
    return {pair: registration.first_from_second for pair, registration in found.items() if registration.accepted}


@pytest.mark.parametrize(("foreground", "steps"), [(0.6, 1), (0.6, 2), (1.0, 1)])
def test_no_wrong_motion_is_accepted(foreground: float, steps: int) -> None:
    found = registrations(replace(CUT, foreground=foreground), steps)
    assert wrong_ones(accepted(found)) == []
    assert any(is_wrong(r.first_from_second, true_motion(*pair)) for pair, r in found.items())  # so they were refused


def test_the_geometry_alone_refuses_wrong_motions(monkeypatch: pytest.MonkeyPatch) -> None:
    """With settings that take nearly any motion for true; without looking at the geometry, wrong ones are accepted."""
    found = registrations(CREDULOUS)
    assert not accepted(found)
    assert any("too even" in each.reason for each in found.values())
    monkeypatch.setattr(pair_registration, "_MIN_CONSTRAINT", (-1.0, -1.0))
    assert wrong_ones(accepted(registrations(CREDULOUS)))


def test_a_right_motion_in_a_room_is_accepted() -> None:
    """Frames 2 m from the walls, with the noise of that distance; only the limits of a hand-held camera are set."""
    recording = open_recording(FOLDER / "open3d_rgbd")
    settings = settings_for(recording)
    first, last = (station_view(recording[i], Calibration(recording.rig), settings) for i in (0, 4))
    poses = [recording[i].world_from_station for i in (0, 4)]
    assert poses[0] is not None
    assert poses[1] is not None
    true = invert(poses[0]) @ poses[1]
    found = fine_icp(first, last.sample, true, settings)
    assert alignment_problem(found, settings) == ""
    assert np.linalg.norm(found.first_from_second[:3, 3] - true[:3, 3]) < 0.005


def test_station_registration_accepts_no_wrong_motion_either() -> None:
    stations = replace(orbit(), size=3)
    try:
        motions = {pair: edge.first_from_second for pair, edge in register_stations(stations, CUT).edges.items()}
    except ReconstructionError:  # too few for a row
        motions = {}
    assert wrong_ones(motions) == []
