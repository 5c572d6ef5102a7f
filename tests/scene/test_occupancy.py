from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import make_scene

from greenhouse_gym.common.array_files import compress
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.geometry import distance_to_shapes, shapes_from
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, boxes_covering


def some_space(seed: int = 0) -> OccupancyGrid:
    states = np.random.default_rng(seed).integers(0, 3, (7, 9, 11)).astype(np.uint8)
    return OccupancyGrid.from_states(states, [-0.2, 0.1, 0.3], 0.05)


def test_states_survive_and_points_find_their_voxel() -> None:
    states = np.random.default_rng(0).integers(0, 3, (7, 9, 11)).astype(np.uint8)
    space = some_space()
    np.testing.assert_array_equal(space.states, states)
    np.testing.assert_array_equal(space.states_at(space.centers.reshape(-1, 3)), states.reshape(-1))
    np.testing.assert_array_equal(space.is_known(space.centers.reshape(-1, 3)), states.reshape(-1) != UNKNOWN)
    assert space.states_at([[-0.21, 0.2, 0.4], [5, 5, 5]]).tolist() == [UNKNOWN, UNKNOWN]  # outside nothing was seen
    assert {UNKNOWN, FREE, OCCUPIED} == set(states.reshape(-1).tolist())
    assert space.known_fraction([0.0, 0.3, 0.6], 10.0) == pytest.approx((states != UNKNOWN).mean())
    assert np.isnan(space.known_fraction([5.0, 5.0, 5.0], 0.1))


def test_a_scene_carries_what_was_seen(tmp_path: Path) -> None:
    scene = make_scene(0).model_copy(update={"occupancy": some_space()})
    again = Scene.load(scene.save(tmp_path / "scene.json"))
    assert again.occupancy is not None
    np.testing.assert_array_equal(again.occupancy.states, some_space().states)
    assert again.occupancy.is_known([[0.0, 0.3, 0.5]]).shape == (1,)
    assert Scene.load(make_scene(0).save(tmp_path / "without.json")).occupancy is None


def test_it_is_small() -> None:
    """A space as large as an arm's, with a seen wedge and a ragged surface at its end."""
    x, y, z = np.indices((54, 54, 49))
    states = np.where((np.abs(z - 24) < x) & (x < 30 + 3 * np.sin(y)), FREE, UNKNOWN).astype(np.uint8)
    states[np.random.default_rng(0).random(states.shape) < 0.01] = OCCUPIED
    assert len(OccupancyGrid.from_states(states, [0, 0, 0], 0.05).model_dump_json()) < 10_000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shape": [7, 9, 12]}, "damaged"),
        ({"shape": [0, 9, 11]}, "voxels"),
        ({"shape": [10**6, 10**6, 10**6]}, "voxels"),
        ({"xz": "?"}, "damaged"),
        ({"xz": compress(bytes(10**7))}, "damaged"),
        ({"xz": compress(bytes([3]) * (7 * 9 * 11))}, "states of voxels"),
        ({"voxel": 0.0}, "voxel"),
        ({"origin": [0, 0]}, "origin"),
    ],
)
def test_voxels_that_do_not_match_are_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    data = make_scene(0).model_copy(update={"occupancy": some_space()}).model_dump(mode="json")
    data["occupancy"].update(change)
    path = tmp_path / "damaged.json"
    path.write_text(json.dumps(data))
    with pytest.raises(FileFormatError, match=f"occupancy.*{message}"):
        Scene.load(path)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 1.0])
def test_boxes_cover_the_marked_cells_and_no_others(share: float) -> None:
    cells = np.random.default_rng(1).random((6, 7, 8)) < share
    boxes = shapes_from(boxes_covering(cells, [0.1, -0.2, 0.3], 0.05))
    centers = np.array([0.1, -0.2, 0.3]) + (np.argwhere(np.ones_like(cells)) + 0.5) * 0.05
    inside = distance_to_shapes(centers, boxes).min(axis=1) < 0 if boxes else np.zeros(len(centers), dtype=bool)
    np.testing.assert_array_equal(inside, cells.reshape(-1))
    volume = sum(8 * box.half_extents.prod() for box in boxes)
    assert volume == pytest.approx(cells.sum() * 0.05**3)  # no two overlap
    assert len(boxes) == (1 if share == 1.0 else len(boxes))


def test_cells_that_do_not_matter_make_boxes_fewer() -> None:
    random = np.random.default_rng(2)
    cells, either_way = random.random((2, 6, 7, 8)) < [[[[0.3]]], [[[0.5]]]]
    either_way &= ~cells
    boxes = shapes_from(boxes_covering(cells, np.zeros(3), 1.0, either_way))
    centers = np.argwhere(np.ones_like(cells)) + 0.5
    inside = (distance_to_shapes(centers, boxes).min(axis=1) < 0).reshape(cells.shape)
    assert inside[cells].all()
    assert not inside[~cells & ~either_way].any()
    ball = np.linalg.norm(np.argwhere(np.ones_like(cells)) - 3, axis=1).reshape(cells.shape) < 2.5
    few, more = (boxes_covering(ball, np.zeros(3), 1.0, optional) for optional in (~ball, None))
    assert len(few.kinds) < len(more.kinds)


def test_spaces_of_nothing_are_refused() -> None:
    with pytest.raises((InvalidValueError, ValueError), match="voxels"):
        OccupancyGrid.from_states(np.zeros((0, 3, 3), np.uint8), [0, 0, 0], 0.05)
