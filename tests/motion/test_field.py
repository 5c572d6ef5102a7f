from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import pytest

from greenhouse_gym.geometry import (
    Box,
    Capsule,
    Ellipsoid,
    Shape,
    Sphere,
    arrays_of,
    distance_to_ellipsoids,
    distance_to_shapes,
    pose,
    rotation_about,
    transform,
)
from greenhouse_gym.motion.distance_field import (
    CELL,
    MAX_DISTANCE,
    NO_TOMATO,
    ORIGIN,
    SHAPE,
    FieldStore,
    obstacle_field,
)
from greenhouse_gym.motion.float16_kernels import from_half_bits


def some_shapes(seed: int, count: int = 40) -> list[Shape]:
    random = np.random.default_rng(seed)
    shapes: list[Shape] = []
    for k in range(count):
        center = random.uniform([0.0, -1.0, -0.9], [1.1, 1.0, 1.0])
        if k % 3 == 0:
            shapes.append(Sphere(center, random.uniform(0.01, 0.06)))
        elif k % 3 == 1:
            shapes.append(Capsule(center, center + random.uniform(-0.3, 0.3, 3), random.uniform(0.002, 0.02)))
        else:
            turn = rotation_about(random.normal(size=3), random.uniform(0, 3))
            shapes.append(Box(center, random.uniform(0.005, 0.1, 3), turn))
    return shapes


def test_tomatoes_that_are_ellipsoids_keep_their_shape() -> None:
    scene_from_base = pose(rotation_about([0, 0, 1], 0.4), [0.1, -0.05, 0.9])
    turn = rotation_about([1.0, 0.5, 0.2], 1.0)
    ellipsoid = Ellipsoid(transform(scene_from_base, [[0.5, 0.1, 0.1]])[0], [0.02, 0.04, 0.05], turn)
    ball = Sphere(transform(scene_from_base, [[0.2, 0.0, 0.0]])[0], 0.03)
    field = obstacle_field(arrays_of([ball, ellipsoid]), 2, scene_from_base)
    nodes = tuple(np.random.default_rng(0).integers(0, SHAPE, (4000, 3)).T)
    points = np.stack(nodes, axis=1) * CELL + ORIGIN
    to_ball = np.linalg.norm(points - [0.2, 0.0, 0.0], axis=1) - 0.03
    stretched = distance_to_ellipsoids(transform(scene_from_base, points), ellipsoid.center, ellipsoid.semi_axes, turn)[
        :, 0
    ]
    expected = np.minimum(np.minimum(to_ball, stretched), MAX_DISTANCE)
    np.testing.assert_allclose(field[nodes]["distance"], expected, atol=3e-4)


def distances(shapes: list[Shape], scene_from_base: np.ndarray | None = None) -> np.ndarray:
    return obstacle_field(arrays_of(shapes), 0, scene_from_base)["distance"]


def inside_points(seed: int, count: int) -> np.ndarray:
    top = np.array(ORIGIN) + (np.array(SHAPE) - 1) * CELL
    return np.random.default_rng(seed).uniform(ORIGIN, top, (count, 3))


@pytest.mark.parametrize("seed", range(3))
def test_nodes_hold_the_exact_distance(seed: int) -> None:
    scene_from_base = pose(rotation_about([0, 0, 1], 0.4), [0.1, -0.05, 0.9])
    shapes = some_shapes(seed)
    field = distances(shapes, pose())
    nodes = np.random.default_rng(seed).integers(0, SHAPE, (3000, 3))
    points = nodes * CELL + ORIGIN
    expected = np.minimum(distance_to_shapes(points, shapes).min(axis=1), MAX_DISTANCE)
    np.testing.assert_allclose(field[tuple(nodes.T)], expected, atol=3e-4)
    turned = distances(shapes, scene_from_base)
    expected = np.minimum(distance_to_shapes(transform(scene_from_base, points), shapes).min(axis=1), MAX_DISTANCE)
    np.testing.assert_allclose(turned[tuple(nodes.T)], expected, atol=3e-4)


def test_without_shapes_everything_is_far() -> None:
    assert (distances([]) == np.float16(MAX_DISTANCE)).all()
    behind = distances([Sphere([-5.0, 0.0, 0.0], 0.1)])
    assert (behind == np.float16(MAX_DISTANCE)).all()


def test_nodes_know_the_distance_without_the_tomato_that_is_nearest() -> None:
    random = np.random.default_rng(0)
    scene_from_base = pose(rotation_about([0, 0, 1], 0.4), [0.1, -0.05, 0.9])
    centers = random.uniform([0.0, -1.0, -0.9], [1.1, 1.0, 1.0], (25, 3))
    centers[1] = centers[0] + [0.03, 0.0, 0.0]  # two that overlap
    tomatoes = np.column_stack([centers, random.uniform(0.01, 0.04, 25)])
    others = some_shapes(1, 15)
    balls = [Sphere(c, r) for c, r in zip(transform(scene_from_base, centers), tomatoes[:, 3], strict=True)]
    field = obstacle_field(arrays_of([*balls, *others]), 25, scene_from_base)
    nodes = tuple(random.integers(0, SHAPE, (4000, 3)).T)
    points = np.stack(nodes, axis=1) * CELL + ORIGIN
    to_others = distance_to_shapes(transform(scene_from_base, points), others).min(axis=1, keepdims=True)
    every = np.hstack([np.linalg.norm(points[:, None] - centers, axis=-1) - tomatoes[:, 3], to_others])
    nearest = every.argmin(axis=1)
    first, second = np.sort(every, axis=1)[:, :2].T
    found = field[nodes]
    np.testing.assert_allclose(found["distance"], np.minimum(first, MAX_DISTANCE), atol=3e-4)
    known = (nearest < 25) & (first < MAX_DISTANCE - 1e-3) & (second - first > 1e-6)
    assert known.sum() > 300
    np.testing.assert_array_equal(found["tomato"][known], nearest[known])
    np.testing.assert_allclose(found["otherwise"][known], np.minimum(second, MAX_DISTANCE)[known], atol=3e-4)
    assert (found["tomato"][nearest == 25] == -1).all()


def test_a_tomato_that_is_ignored_is_not_there() -> None:
    random = np.random.default_rng(2)
    tomatoes: list[Shape] = [Sphere(c, 0.03) for c in random.uniform([0.4, -0.3, -0.3], [0.8, 0.3, 0.3], (9, 3))]
    store = FieldStore()
    whole = store.add(arrays_of([*tomatoes, *some_shapes(3, 5)]), 9)
    points = random.uniform([0.3, -0.4, -0.4], [0.9, 0.4, 0.4], (1, 500, 3))
    changed = 0
    for k in range(9):
        without = store.add(arrays_of([*tomatoes[:k], *tomatoes[k + 1 :], *some_shapes(3, 5)]), 8)
        expected = store.lookup(np.array([without]), np.array([NO_TOMATO]), points)
        for one, other in zip(store.lookup(np.array([whole]), np.array([k]), points), expected, strict=True):
            np.testing.assert_array_equal(one, other)
        changed += (store.lookup(np.array([whole]), np.array([NO_TOMATO]), points)[0] != expected[0]).sum()
    assert changed > 300


def keep(store: FieldStore, shapes: list[Shape]) -> int:
    return store.add(arrays_of(shapes))


def test_lookup_interpolates_distance_and_direction() -> None:
    ball = Sphere([0.6, 0.0, 0.0], 0.05)
    store = FieldStore()
    slot = keep(store, [ball])
    points = inside_points(0, 4000)
    points = points[np.linalg.norm(points - ball.center, axis=1) > 0.08]
    distance, direction = store.lookup(np.array([slot]), np.array([NO_TOMATO]), points[None])
    expected = np.linalg.norm(points - ball.center, axis=1) - 0.05
    np.testing.assert_allclose(distance[0], np.minimum(expected, MAX_DISTANCE), atol=5e-3)
    near = expected < MAX_DISTANCE - 0.03
    towards = (ball.center - points) / np.linalg.norm(ball.center - points, axis=1, keepdims=True)
    assert ((direction[0] * towards).sum(axis=1)[near] > 0.98).all()
    assert (direction[0][expected > MAX_DISTANCE + 0.03] == 0).all()


def test_outside_the_grid_the_way_to_it_is_added() -> None:
    store = FieldStore()
    slot = keep(store, [Sphere([0.12, 0.0, 0.0], 0.03)])
    distance, _ = store.lookup(
        np.array([slot]), np.array([NO_TOMATO]), np.array([[[0.0, 0.0, 0.0], [-5.0, 0.0, 0.0], [0.5, 30.0, 1.0]]])
    )
    np.testing.assert_allclose(distance[0], [0.09, MAX_DISTANCE, MAX_DISTANCE], atol=5e-3)


def test_many_scenes_at_once_give_what_each_gives_alone() -> None:
    store = FieldStore()
    slots = np.array([keep(store, some_shapes(seed, 6)) for seed in range(18)])  # grows once
    everything = np.full(18, NO_TOMATO)
    points = inside_points(1, 18 * 9).reshape(18, 9, 3)
    distance, direction = store.lookup(slots, everything, points)
    for i in range(18):
        alone = store.lookup(slots[i : i + 1], everything[i : i + 1], points[i : i + 1])
        np.testing.assert_array_equal(alone[0][0], distance[i])
        np.testing.assert_array_equal(alone[1][0], direction[i])
    assert len(np.unique(distance[:, 0])) > 3


def test_lookups_at_nodes_give_the_nodes_of_the_whole_field_wherever_they_are_computed_first() -> None:
    scene_from_base = pose(rotation_about([0, 0, 1], 0.4), [0.1, -0.05, 0.9])
    shapes = arrays_of(some_shapes(4))
    whole = np.minimum(obstacle_field(shapes, 0, scene_from_base)["distance"], MAX_DISTANCE)
    store, everything = FieldStore(), np.array([NO_TOMATO])
    slot = np.array([store.add(shapes, 0, scene_from_base)])
    nodes = np.random.default_rng(0).integers(0, np.array(SHAPE) - 1, (3000, 3))
    for some in (nodes[:1], nodes[1:40], nodes):  # few columns at first
        found, _ = store.lookup(slot, everything, (some * CELL + ORIGIN)[None])
        np.testing.assert_allclose(found[0], whole[tuple(some.T)], atol=1e-4)


def test_fields_that_are_removed_leave_their_room_but_no_distances_to_those_after_them() -> None:
    store, everything, points = FieldStore(), np.array([NO_TOMATO]), inside_points(3, 3000)[None]
    fresh = FieldStore()
    expected = fresh.lookup(np.array([keep(fresh, some_shapes(0))]), everything, points)[0]
    columns = []
    for seed in (1, 2, 3, 0):
        columns.append(len(store._nodes) - len(store._unused))
        slot = keep(store, some_shapes(seed))
        found = store.lookup(np.array([slot]), everything, points)[0]
        if seed:
            assert (found != expected).any()
            store.remove(slot)
            assert len(store) == 0
    assert columns == [0] * 4
    np.testing.assert_array_equal(found, expected)


def test_threads_share_a_store() -> None:
    everything, kinds = np.array([NO_TOMATO]), range(6)
    points = [inside_points(seed, 400)[None] for seed in kinds]
    alone = FieldStore()
    expected = [alone.lookup(np.array([keep(alone, some_shapes(k))]), everything, points[k])[0] for k in kinds]
    shared = FieldStore()
    slots = [np.array([keep(shared, some_shapes(k))]) for k in kinds]

    def found(k: int) -> np.ndarray:
        parts = np.array_split(points[k], 100, axis=1)  # columns are computed by turns
        return np.concatenate([shared.lookup(slots[k], everything, part)[0] for part in parts], axis=1)

    with ThreadPoolExecutor(len(kinds)) as threads:
        for own, result in zip(expected, threads.map(found, kinds), strict=True):
            np.testing.assert_array_equal(result, own)


def test_what_is_no_number_has_no_distance_and_disturbs_no_other_point() -> None:
    store, rng = FieldStore(), np.random.default_rng(0)
    slots = np.array([store.add(arrays_of(some_shapes(3)))])
    points = rng.uniform([0.2, -0.5, -0.5], [0.9, 0.5, 0.5], (1, 6, 3))
    expected = store.lookup(slots, np.array([NO_TOMATO]), points)[0]
    points[0, 2, 1], points[0, 4] = np.nan, np.inf
    distances = store.lookup(slots, np.array([NO_TOMATO]), points)[0]
    assert np.isnan(distances[0, 2])
    assert distances[0, 4] == np.float32(MAX_DISTANCE)
    kept = [0, 1, 3, 5]
    np.testing.assert_array_equal(distances[0, kept], expected[0, kept])


def test_every_finite_float16_is_read_as_itself() -> None:
    bits = np.arange(1 << 16, dtype=np.uint32)
    numbers = bits.astype(np.uint16).view(np.float16).astype(np.float32)
    finite = np.isfinite(numbers)
    read = numba.njit(lambda values: [from_half_bits(value) for value in values])(bits[finite])
    np.testing.assert_array_equal(np.array(read, dtype=np.float32).view(np.uint32), numbers[finite].view(np.uint32))
