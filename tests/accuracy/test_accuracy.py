from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
from row_helpers import HALF

from greenhouse_gym.accuracy import (
    completeness,
    distance_to_surface,
    distance_to_truth,
    drift,
    place,
    place_by_windows,
    visible_surface,
)
from greenhouse_gym.capture import CaptureSettings
from greenhouse_gym.capture.simulated import tripod_poses
from greenhouse_gym.crops import PlantRow, grow_row
from greenhouse_gym.geometry import Array, distance_to_shapes, invert, pose, rotation_about, transform

STATIONS = 12


@dataclass(frozen=True, eq=False)
class KnownRow:
    points: Array
    registered: npt.NDArray[np.bool_]
    world_from_station: Array


@cache
def truth() -> PlantRow:
    return grow_row(seed=1, length=1.2)


@cache
def true_walk() -> Array:
    return tripod_poses(STATIONS, 1, HALF, CaptureSettings())


@cache
def surface() -> Array:
    """Return the parts of the row that the cameras observed, in the world."""
    return visible_surface(truth(), HALF, true_walk())


def row_of(points: Array, world_from_station: Array) -> KnownRow:
    """A row from points and stations in the world, moved into the frame of the first station."""
    first = invert(world_from_station[0])
    return KnownRow(transform(first, points), np.ones(len(world_from_station), bool), first @ world_from_station)


def perfect() -> KnownRow:
    return row_of(surface(), true_walk())


def moved(by: Array) -> KnownRow:
    """Every point off by one rigid motion in the world, the stations right."""
    return row_of(transform(by, surface()), true_walk())


def bent(per_metre: float) -> KnownRow:
    """From the end of the first of three windows on, the row turns away by ``per_metre`` metres a metre."""
    low, high = surface()[:, 1].min(), surface()[:, 1].max()
    joint = np.array([0.5, low + (high - low) / 3, 0.0])
    turn = rotation_about([0, 0, 1], -per_metre)
    second = pose(turn, joint - turn @ joint)
    points, stations = surface().copy(), true_walk().copy()
    points[points[:, 1] > joint[1]] = transform(second, points[points[:, 1] > joint[1]])
    late = stations[:, 1, 3] > joint[1]
    stations[late] = second @ stations[late]
    return row_of(points, stations)


def aligned(row: KnownRow) -> Array:
    return place_by_windows(row, truth(), true_walk())


def test_visible_surface_lies_on_the_true_shapes_within_the_cut() -> None:
    assert distance_to_surface(surface(), truth()).max() < 1e-4
    shapes = truth().shapes
    assert np.abs(distance_to_shapes(surface()[::500], shapes)).min(axis=1).max() < 5e-4
    reach = 0.60 + CaptureSettings().offset_error + np.sin(2 * CaptureSettings().angle_error)
    assert surface()[:, 0].max() < reach
    assert surface()[:, 1].min() < 0 < 1.2 < surface()[:, 1].max()


def test_visible_surface_counts_every_bit_of_surface_once() -> None:
    again = visible_surface(truth(), HALF, np.concatenate([true_walk()[:3], true_walk()[:3]]))
    np.testing.assert_array_equal(again, visible_surface(truth(), HALF, true_walk()[:3]))
    cubes = np.floor(surface() / 0.004)
    assert len(np.unique(cubes, axis=0)) == len(cubes)


def test_a_perfect_cloud_has_no_distance_and_is_complete() -> None:
    row = perfect()
    assert distance_to_truth(row, truth(), true_walk()[0]).max() < 1e-4
    np.testing.assert_allclose(place(row, true_walk()), surface(), atol=1e-9)
    assert completeness(place(row, true_walk()), surface()) == 1.0
    assert np.linalg.norm(aligned(row) - surface(), axis=1).max() < 1e-4


def test_one_centimetre_off_is_bad_as_it_is_and_good_once_aligned() -> None:
    row = moved(pose(rotation_about([0, 0, 1], 0.002), [0.0, 0.0, 0.01]))
    plain = distance_to_truth(row, truth(), true_walk()[0])
    assert plain.mean() > 0.003
    assert completeness(place(row, true_walk()), surface()) < 0.8
    back = aligned(row)
    assert distance_to_surface(back, truth()).mean() < 1e-4
    assert np.median(np.linalg.norm(back - surface(), axis=1)) < 1e-4
    assert completeness(back, surface()) > 0.999


def test_alignment_takes_out_drift_and_not_noise() -> None:
    row = bent(per_metre=0.03)
    assert drift(row, true_walk()).error == pytest.approx(0.03, abs=0.005)
    assert distance_to_truth(row, truth(), true_walk()[0]).mean() > 0.002
    straight = aligned(row)
    assert distance_to_surface(straight, truth()).mean() < 5e-4
    assert completeness(straight, surface()) > 0.97

    noise = np.random.default_rng(0).normal(0, 0.002, surface().shape)
    noisy = KnownRow(row.points + noise, row.registered, row.world_from_station)
    assert 0.0010 < distance_to_surface(aligned(noisy), truth()).mean() < 0.0018


def test_alignment_is_not_drawn_by_outliers() -> None:
    ghost = surface()[::5] + [0.0, 0.012, 0.007]
    row = row_of(np.concatenate([surface(), ghost]), true_walk())
    off = np.linalg.norm(aligned(row)[: len(surface())] - surface(), axis=1)
    assert off.max() < 0.0015


def test_alignment_survives_a_station_in_the_wrong_place() -> None:
    row = perfect()
    stations = row.world_from_station.copy()
    stations[2] = pose(translation=[0.0, 0.3, 0.0]) @ stations[2]
    wrong = KnownRow(row.points, row.registered, stations)
    assert distance_to_surface(aligned(wrong), truth()).mean() < 1e-4


def test_half_a_cloud_is_half_complete() -> None:
    low = surface()[:, 2] < np.median(surface()[:, 2])
    share = completeness(surface()[low], surface())
    assert share == pytest.approx(0.5, abs=0.03)
    assert completeness(np.zeros((1, 3)), surface()) == 0.0


def test_drift_is_that_of_the_last_registered_station() -> None:
    row = perfect()
    assert drift(row, true_walk()).error < 1e-9
    stations = row.world_from_station.copy()
    stations[8, :3, 3] += [0.0, 0.03, 0.04]
    stations[9:] = np.nan
    registered = np.arange(STATIONS) < 9
    found = drift(KnownRow(row.points, registered, stations), true_walk())
    assert found.error == pytest.approx(0.05)
    walked = np.linalg.norm(np.diff(true_walk()[:9, :3, 3], axis=0), axis=1).sum()
    assert found.fraction == pytest.approx(0.05 / walked)
