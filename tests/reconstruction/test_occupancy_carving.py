from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from row_helpers import HALF, half_cloud, half_recording

from greenhouse_gym.crops import PlantRow
from greenhouse_gym.errors import ReconstructionError
from greenhouse_gym.geometry import distance_to_shapes, pose
from greenhouse_gym.reconstruction import RowCloud, RowReport
from greenhouse_gym.reconstruction.occupancy_carving import CarvingSettings, carve
from greenhouse_gym.reconstruction.row_cloud import ObservedSpace
from greenhouse_gym.reconstruction.station_views import BLOCK
from greenhouse_gym.scene.occupancy import FREE, OCCUPIED, UNKNOWN

LOW, HIGH = np.array([-0.3, -0.6, 0.3]), np.array([1.2, 0.6, 2.0])


def looking_at(depth: float, points: np.ndarray | None = None) -> RowCloud:
    """One station whose cameras all measure one depth everywhere."""
    cloud = np.zeros((0, 3)) if points is None else points
    k = HALF.cameras["middle"].intrinsics
    screen = np.full((-(-k.height // BLOCK), -(-k.width // BLOCK)), round(1000 * depth), dtype=np.uint16)
    return RowCloud(
        cloud, cloud, cloud, np.zeros(len(cloud), np.int32), np.array([True]), np.eye(4)[None], RowReport(()),
        ObservedSpace(HALF, {0: dict.fromkeys(HALF.cameras, screen)}),
    )  # fmt: skip


def states_at(row: RowCloud, points: list[list[float]], settings: CarvingSettings | None = None) -> list[int]:
    carving = carve(row, np.eye(4), LOW, HIGH, settings)
    cells = np.floor((np.array(points) - carving.origin) / carving.voxel).astype(int)
    return [int(carving.states[tuple(cell)]) for cell in cells]


def test_space_is_empty_up_to_the_reading_and_unknown_behind_and_next_to_it() -> None:
    before, behind, above, aisle = [0.52, 0.02, 1.12], [0.92, 0.02, 1.12], [0.32, 0.02, 1.82], [-0.22, 0.02, 1.82]
    assert states_at(looking_at(0.8), [before, behind, above, aisle]) == [FREE, UNKNOWN, UNKNOWN, FREE]
    assert states_at(looking_at(0.0), [before, behind, above, aisle]) == [UNKNOWN, UNKNOWN, UNKNOWN, FREE]
    assert states_at(looking_at(0.8), [aisle], CarvingSettings(aisle=False)) == [UNKNOWN]


def test_points_of_the_cloud_make_surface_whatever_was_seen_through() -> None:
    place = np.array([0.52, 0.02, 1.12])
    row = looking_at(0.8, place + np.random.default_rng(0).uniform(-0.01, 0.01, (10, 3)))
    assert states_at(row, [place.tolist()]) == [OCCUPIED]
    single = looking_at(0.8, place[None])
    assert states_at(single, [place.tolist()]) == [FREE]


def test_a_part_keeps_its_place() -> None:
    whole = carve(looking_at(0.8), np.eye(4), LOW, HIGH)
    part, origin = whole.cut([0.2, -0.3, 0.8], [0.9, 0.3, 1.4])
    again = carve(looking_at(0.8), np.eye(4), [0.2, -0.3, 0.8], [0.9, 0.3, 1.4])
    np.testing.assert_allclose(origin, again.origin)
    assert part.shape == again.states.shape
    np.testing.assert_array_equal(part == UNKNOWN, again.states == UNKNOWN)


@pytest.mark.xdist_group("row")
def test_what_was_carved_out_of_a_row_is_empty_in_the_truth() -> None:
    row, recording = half_cloud(), half_recording()
    first = int(np.flatnonzero(row.registered)[0])
    true_from_first = recording[first].world_from_station
    assert true_from_first is not None
    carving = carve(row, true_from_first, [-0.3, -0.6, 0.3], [0.9, 1.1, 2.0])
    truth = recording.truth
    assert isinstance(truth, PlantRow)
    empty = np.argwhere(carving.states == FREE)
    centers = carving.origin + (empty + 0.5) * carving.voxel
    shapes = truth.shapes
    thick = [s for s in shapes if getattr(s, "radius", 1.0) > 0.003]  # strings are seen by few pixels
    inside = distance_to_shapes(centers, thick).min(axis=1) < 0
    assert len(empty) > 3000
    assert inside.mean() < 0.003
    assert 0.2 < (carving.states == UNKNOWN).mean() < 0.9
    aside = carve(row, pose(translation=[5, 0, 0]) @ true_from_first, [4.7, -0.6, 0.3], [5.9, 1.1, 2.0])
    assert (aside.states == carving.states).mean() > 0.999


def test_a_cloud_from_a_file_cannot_be_carved() -> None:
    with pytest.raises(ReconstructionError, match="depth images"):
        carve(replace(looking_at(0.8), observed=None), np.eye(4), LOW, HIGH)
