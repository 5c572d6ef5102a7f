"""Missing readings and far points neither turn nor cut a scan."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from greenhouse_gym.build.scans import RawCloud, open_scan
from greenhouse_gym.build.scans.frame import without_strays
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array

RNG = np.random.default_rng(0)
CAMERA_FROM_ROW = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # x right, y down, z ahead


@cache
def row() -> Array:
    """Four stems along y at x = 0.5, in metres."""
    parts = []
    for y in np.arange(0, 1.6, 0.4):
        angle, z = RNG.uniform(0, 2 * np.pi, 2000), RNG.uniform(0.3, 1.9, 2000)
        parts.append(np.column_stack([0.5 + 0.006 * np.cos(angle), y + 0.006 * np.sin(angle), z]))
    return np.concatenate(parts)


def before_camera() -> Array:
    return (row() - [0.0, 0.6, 1.1]) @ CAMERA_FROM_ROW.T


def scatter(count: int, spread: float, middle: tuple[float, float, float] = (0, 0, 0)) -> Array:
    return middle + RNG.normal(0, spread, (count, 3))


STRAYS = {
    "none": np.zeros((0, 3)),
    "65.535 m, scattered": scatter(80, 20.0) * [0, 1, 1] + [65.535, 0, 0],
    "65.535 m, one position": np.tile([65.535, 0, 0], (80, 1)),
    "scattered everywhere": scatter(400, 60.0),
    "a reflection": scatter(600, 0.3, (40.0, 3.0, 1.0)),
    "a ray": np.column_stack([np.linspace(3, 65, 200), scatter(200, 0.3)[:, 1:]]),
    "one at 1e155": np.array([[1e155, 0, 0]]),
    "at the largest numbers": RNG.choice([-1.7e308, 1.7e308], (50, 3)),
    "no numbers": np.array([[np.nan, 0, 0], [np.inf, 0, 0]]),
    "one zero": np.zeros((1, 3)),
    "more zeros than points": np.zeros((12_000, 3)),
    "another position without a reading": np.tile([-1.0, -1.0, -1.0], (1200, 1)),
}


@pytest.mark.parametrize("name", STRAYS)
def test_strays_are_left_out_and_nothing_else(name: str) -> None:
    points = np.concatenate([row(), STRAYS[name]])
    colors = RNG.random(points.shape)
    cloud = without_strays(RawCloud(points, colors, notes=("before",)))
    np.testing.assert_array_equal(cloud.points, row())
    np.testing.assert_array_equal(cloud.colors, colors[: len(row())])  # type: ignore[arg-type]
    assert cloud.notes[0] == "before"
    assert any("left out" in note for note in cloud.notes) == (name != "none")


def test_parts_of_a_scan_are_no_strays() -> None:
    """Rows with gaps, a plant at the end, a wall that a floor connects, and far less dense parts."""
    floor = np.column_stack([RNG.uniform(0, 6, 4000), RNG.uniform(-2, 4, 4000), np.zeros(4000)])
    wall = np.column_stack([np.full(500, 6.0), RNG.uniform(-2, 4, 500), RNG.uniform(0, 3, 500)])
    for part in (
        row() + [0, 6, 0],
        row()[:400] + [0, 1.5, 0],
        np.concatenate([floor, wall]),
        scatter(120, 0.5, (1, 1, 1)),
    ):
        points = np.concatenate([row(), part])
        assert len(without_strays(RawCloud(points)).points) == len(points)


@pytest.mark.parametrize("name", ["65.535 m, scattered", "more zeros than points", "at the largest numbers"])
@pytest.mark.parametrize("in_camera", [False, True])
def test_a_scan_with_strays_comes_to_stand_as_without(name: str, in_camera: bool) -> None:
    points = before_camera() if in_camera else row()
    scan = open_scan(RawCloud(np.concatenate([points, STRAYS[name]])))
    np.testing.assert_allclose(scan.row_from_file, open_scan(RawCloud(points)).row_from_file)
    assert scan.unit == 1.0
    np.testing.assert_allclose(scan.row_from_file[2, :3], [0, -1, 0] if in_camera else [0, 0, 1])


def test_noise_behind_a_camera_does_not_turn_its_cloud_over() -> None:
    noise = np.column_stack([scatter(24, 0.1)[:, :2], -np.abs(scatter(24, 0.1)[:, 2])])
    scan = open_scan(RawCloud(np.concatenate([before_camera(), noise])))
    np.testing.assert_allclose(scan.row_from_file[2, :3], [0, -1, 0])


@pytest.mark.parametrize(
    ("points", "units", "problem"),
    [
        (row() * 1e155, None, "give the units"),
        (row() * 1e300, "mm", "give the units"),
        (row() * 2000, "m", "measures 3.2e"),
        (row() * 1e-200, None, "give the units"),
        (np.zeros((1000, 3)), None, "1000 points at .0, 0, 0. are missing readings"),
        (np.ones((1000, 3)), None, "holds 0 points"),
        (row()[:20], None, "holds 20 points, too few"),
        (np.full((100, 3), np.nan), None, "100 points have no finite position"),
    ],
)
def test_points_that_are_no_row_are_refused(points: Array, units: str | None, problem: str) -> None:
    with pytest.raises(FileFormatError, match=problem):
        open_scan(RawCloud(points), units=units)


def test_the_unit_of_the_file_is_used_unless_another_is_given() -> None:
    cloud = RawCloud(row() / 0.3048, unit=0.3048, notes=("units: the file states foot (0.3048 m)",))
    scan = open_scan(cloud)
    assert scan.unit == 0.3048
    assert [note for note in scan.notes if note.startswith("units")] == ["units: the file states foot (0.3048 m)"]
    assert open_scan(cloud, units="us-ft").unit == pytest.approx(1200 / 3937)
