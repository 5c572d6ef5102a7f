from __future__ import annotations

import itertools

import numpy as np
import pytest
from row_helpers import full_cloud, full_recording, grown, true_poses

from greenhouse_gym.accuracy import match_tomatoes, visible_tomatoes
from greenhouse_gym.crops import Palette
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Ellipsoid, Sphere, distance_to_shapes, invert, transform
from greenhouse_gym.reconstruction.point_clouds import Cloud
from greenhouse_gym.shapes import FINE_SHAPES, RowShapes, ShapeSettings, ShapeWarning, extract_shapes
from greenhouse_gym.shapes.clutter import bounding_box, box_budget, cover
from greenhouse_gym.shapes.colors import could_be_fruit, could_be_stem, redness
from greenhouse_gym.shapes.evidence import nearest_shapes
from greenhouse_gym.shapes.peduncles import find_peduncles
from greenhouse_gym.shapes.polylines import fitted, kept_rows
from greenhouse_gym.shapes.surfaces import NO_LEAF, SurfaceCloud, look_at_surfaces
from greenhouse_gym.shapes.tomatoes import ripeness_of
from greenhouse_gym.shapes.trusses import group_trusses

SETTINGS = ShapeSettings()
RED = np.array([0.76, 0.10, 0.07])
CAMERA = np.array([0.0, 0.2, 1.1])


def half_sphere(
    center: tuple[float, float, float], radius: float, seed: int = 0, noise: float = 0.001, color: np.ndarray = RED
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, colors and normals of the side of a ball that faces the camera, one per 2 mm square, with noise."""
    random = np.random.default_rng(seed)
    unit = random.normal(size=(int(4 * np.pi * radius**2 / 0.002**2), 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    unit = unit[unit @ (CAMERA - center) > 0]
    points = center + (radius + random.normal(0, noise, (len(unit), 1))) * unit
    normals = unit + random.normal(0, 0.1, unit.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = np.clip(color * random.uniform(0.5, 1.2, (len(unit), 1)), 0, 1)
    return points, colors, normals


def together(*parts: tuple[np.ndarray, np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))  # type: ignore[return-value]


def cylinder(
    x: float, y: float, low: float, high: float, radius: float, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The side of an upright cylinder that faces the camera."""
    random = np.random.default_rng(seed)
    count = int(np.pi * radius * (high - low) / 0.002**2)
    angle = random.uniform(np.pi / 2, 3 * np.pi / 2, count)
    normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    points = np.column_stack([np.full(count, x), np.full(count, y), random.uniform(low, high, count)])
    points += (radius + random.normal(0, 0.0007, (count, 1))) * normals
    return points, np.tile([0.36, 0.50, 0.22], (count, 1)), normals


def plane(seed: int = 0, count: int = 20_000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    points = np.column_stack([np.full(count, 0.5), random.uniform(0, 0.4, count), random.uniform(0.9, 1.3, count)])
    points[:, 0] += random.normal(0, 0.001, count)
    return points, np.full((count, 3), 0.5), np.tile([-1.0, 0.0, 0.0], (count, 1))


def assert_nothing_swallows(shapes: RowShapes, points: np.ndarray) -> None:
    """No single shape holds much more than what was seen there."""
    extent = np.ptp(points, axis=0).max() if len(points) else 0.0
    for shape in (*(tomato.shape for tomato in shapes.tomatoes), *shapes.stems):
        assert shape.radius < 0.05
    for box in shapes.clutter:
        assert 2 * box.half_extents.max() <= np.sqrt(3) * extent + 0.01


# -- ideal shapes -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [0.0135, 0.0225, 0.028, 0.0335, 0.046])
@pytest.mark.parametrize("seed", range(3))
def test_a_single_ball_is_found(radius: float, seed: int) -> None:
    center = (0.45, 0.2 + 0.05 * seed, 1.1 - 0.07 * seed)
    shapes = extract_shapes(*half_sphere(center, radius, seed))
    assert len(shapes.tomatoes) == 1
    assert np.linalg.norm(shapes.tomatoes[0].center - center) < 0.002
    assert shapes.tomatoes[0].radius == pytest.approx(radius, rel=0.02)
    assert shapes.stems == ()


def test_normals_are_estimated_when_they_are_left_out() -> None:
    points, colors, _ = half_sphere((0.45, 0.2, 1.1), 0.03, noise=0.0005)
    shapes = extract_shapes(points, colors)
    assert len(shapes.tomatoes) == 1
    assert np.linalg.norm(shapes.tomatoes[0].center - [0.45, 0.2, 1.1]) < 0.002


@pytest.mark.parametrize("apart", [(0, 1, 0), (0, 0, 1), (0, 0.6, 0.8)])
def test_touching_balls_are_told_apart(apart: tuple[float, float, float]) -> None:
    first = np.array([0.45, 0.15, 1.1])
    second = first + 0.056 * np.array(apart)
    shapes = extract_shapes(*together(half_sphere(tuple(first), 0.03, 0), half_sphere(tuple(second), 0.026, 1)))
    matches = match_tomatoes(
        [Tomato(Sphere(first, 0.03), truss=0), Tomato(Sphere(second, 0.026), truss=0)], shapes.tomatoes
    )
    assert len(matches.true) == len(shapes.tomatoes) == 2
    assert matches.center_errors.max() < 0.002
    assert matches.diameter_errors.max() < 0.06
    assert len({tomato.truss for tomato in shapes.tomatoes}) == 1


def sliver(center: tuple[float, float, float], radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The upper edge of a ball whose lower part is hidden."""
    points, colors, normals = half_sphere(center, radius, 7)
    shown = points[:, 2] > center[2] + 0.35 * radius
    return points[shown], colors[shown], normals[shown]


def test_a_hidden_ball_is_found_by_the_size_of_those_beside_it() -> None:
    others = [half_sphere((0.45, 0.15 + 0.0305 * k, 1.1), 0.015, k) for k in range(3)]
    hidden = sliver((0.46, 0.165, 1.13), 0.015)
    assert len(extract_shapes(*together(*others)).tomatoes) == 3
    shapes = extract_shapes(*together(*others, hidden))
    assert len(shapes.tomatoes) == 4
    highest = max(shapes.tomatoes, key=lambda tomato: tomato.center[2])
    assert np.linalg.norm(highest.center - [0.46, 0.165, 1.13]) < 0.005
    assert highest.radius == pytest.approx(0.015, rel=0.03)
    assert len({tomato.truss for tomato in shapes.tomatoes}) == 1


def test_balls_far_apart_hang_on_trusses_of_their_own() -> None:
    shapes = extract_shapes(*together(half_sphere((0.45, 0.1, 1.1), 0.03, 0), half_sphere((0.45, 0.3, 1.1), 0.03, 1)))
    assert sorted(tomato.truss for tomato in shapes.tomatoes) == [0, 1]
    np.testing.assert_array_equal(group_trusses([Sphere([0, 0, 0], 0.03)], 0.015), [0])


@pytest.mark.parametrize(("ripeness", "color"), list(zip(np.linspace(0, 1, 4), np.array(Palette().fruit), strict=True)))
def test_ripeness_comes_from_the_color_whatever_the_light(ripeness: float, color: np.ndarray) -> None:
    shapes = extract_shapes(*half_sphere((0.45, 0.2, 1.1), 0.03, color=color))
    assert shapes.tomatoes[0].ripeness == pytest.approx(ripeness, abs=0.1)
    assert ripeness_of(color[None]) == pytest.approx(ripeness, abs=0.1)
    assert ripeness_of(0.4 * color[None]) == pytest.approx(ripeness_of(color[None]), abs=1e-3)
    assert 0.0 <= ripeness_of(np.zeros((3, 3))) <= 1.0


@pytest.mark.parametrize("radius", [0.005, 0.007])
def test_an_upright_cylinder_is_a_main_stem(radius: float) -> None:
    shapes = extract_shapes(*cylinder(0.5, 0.2, 0.6, 1.4, radius))
    assert shapes.tomatoes == ()
    main = [stem for stem in shapes.stems if stem.kind == "main"]
    assert main
    assert min(s.start[2] for s in main) == pytest.approx(0.6, abs=0.05)
    assert max(s.end[2] for s in main) == pytest.approx(1.4, abs=0.05)
    for stem in main:
        assert stem.radius == pytest.approx(radius, abs=0.0015)
        for end in (stem.start, stem.end):
            np.testing.assert_allclose(end[:2], [0.5, 0.2], atol=0.002)


def test_a_hidden_part_of_a_stem_is_bridged() -> None:
    shapes = extract_shapes(*together(cylinder(0.5, 0.2, 0.6, 0.9, 0.006, 0), cylinder(0.5, 0.2, 1.05, 1.4, 0.006, 1)))
    main = [stem for stem in shapes.stems if stem.kind == "main"]
    hidden = np.column_stack([np.full(20, 0.5), np.full(20, 0.2), np.linspace(0.9, 1.05, 20)])
    assert distance_to_shapes(hidden, main).min(axis=1).max() < 0.002


def test_a_ball_before_a_stem() -> None:
    shapes = extract_shapes(*together(cylinder(0.55, 0.2, 0.6, 1.5, 0.006), half_sphere((0.47, 0.22, 1.1), 0.03)))
    assert len(shapes.tomatoes) == 1
    assert {stem.kind for stem in shapes.stems} == {"main"}


# -- what holds the fruit ---------------------------------------------------------------------------------------------


def truss_of_two() -> tuple[tuple[Tomato, ...], list[Stem], np.ndarray]:
    """Two fruits left and right of a peduncle that leaves a main stem, and the peduncle's and pedicels' points."""
    fruits = (Tomato(Sphere([0.42, 0.16, 1.0], 0.025), 0), Tomato(Sphere([0.42, 0.24, 1.0], 0.025), 0))
    main = [Stem([0.5, 0.2, 0.6], [0.5, 0.2, 1.4], 0.006, "main")]
    ways = [([0.492, 0.2, 1.05], [0.42, 0.2, 1.03])]
    ways += [([0.42, 0.2, 1.03], f.center + 0.025 * (t := np.array([0.42, 0.2, 1.03]) - f.center) / np.linalg.norm(t))
             for f in fruits]  # fmt: skip
    line = [np.linspace(a, b, 60) for a, b in ways]
    return fruits, main, np.concatenate(line)


@pytest.mark.parametrize("hidden", [False, True])
def test_a_peduncle_forks_into_a_pedicel_for_each_fruit(hidden: bool) -> None:
    fruits, main, points = truss_of_two()
    if hidden:  # a leaf in front of a centimetre of the peduncle
        points = points[np.abs(points[:, 0] - 0.46) > 0.005]
    stems = find_peduncles(points, fruits, main, SETTINGS)
    assert {stem.kind for stem in stems} == {"peduncle", "pedicel"}
    assert distance_to_shapes(truss_of_two()[2], stems).min(axis=1).max() < 0.004
    for fruit in fruits:  # connected where the plant is connected
        assert min(abs(np.linalg.norm(s.end - fruit.center) - fruit.radius) for s in stems) < 1e-6
    assert min(distance_to_shapes(np.array([s.start for s in stems]), main).ravel()) < 0.0


def test_fruits_without_anything_near_hang_on_nothing() -> None:
    fruits, main, _ = truss_of_two()
    assert find_peduncles(np.zeros((0, 3)), fruits, main, SETTINGS) == []
    assert find_peduncles(np.array([[3.0, 3.0, 3.0]]), fruits, main, SETTINGS) == []
    assert find_peduncles(truss_of_two()[2], (), main, SETTINGS) == []


def test_a_truss_without_a_main_stem_is_traced_all_the_same() -> None:
    fruits, _, points = truss_of_two()
    stems = find_peduncles(points, fruits, [], SETTINGS)
    assert [stem.kind for stem in stems].count("pedicel") == 2
    assert sum(stem.length for stem in stems) > 0.04  # from fruit to fruit, for nothing tells where the rest leads


@pytest.mark.parametrize("count", [1, 2])
def test_only_several_fruits_make_a_bridge_over_a_wide_gap(count: int) -> None:
    fruits, main, points = truss_of_two()
    seen = points[np.abs(points[:, 0] - 0.46) > 0.015]  # three centimetres of the peduncle are hidden
    stems = find_peduncles(seen, fruits[:count], main, SETTINGS)
    hidden = points[np.abs(points[:, 0] - 0.46) < 0.01]
    assert (distance_to_shapes(hidden, stems).min(axis=1).max() < 0.004) == (count == 2)


def test_a_truss_hangs_from_above_its_middle() -> None:
    fruits, main, points = truss_of_two()
    below = np.linspace([0.492, 0.2, 0.94], [0.42, 0.2, 0.98], 60)  # a leaf's stalk, nearer to the stem's axis
    near = np.linspace([0.42, 0.2, 0.98], [0.42, 0.2, 1.03], 40)
    stems = find_peduncles(np.concatenate([points, below, near]), fruits, main, SETTINGS)
    at_stem = [s for s in stems if distance_to_shapes(s.start[None], main).min() < 0.0]
    assert len(at_stem) == 1
    assert at_stem[0].start[2] > 1.04


@pytest.mark.parametrize("tolerance", [0.001, 0.01])
def test_few_points_of_a_line_stay_near_the_line(tolerance: float) -> None:
    line = wave()
    rows = kept_rows(line, tolerance)
    assert 2 < len(rows) < 60
    assert (rows[0], rows[-1]) == (0, len(line) - 1)
    assert off(line, line[rows]).max() <= tolerance


@pytest.mark.parametrize("tolerance", [0.001, 0.01])
def test_fitted_points_are_nearer_in_the_mean(tolerance: float) -> None:
    line = wave()
    few, own = fitted(line, tolerance), line[kept_rows(line, tolerance)]
    assert len(few) == len(own)
    assert np.mean(off(line, few) ** 2) < 0.7 * np.mean(off(line, own) ** 2)
    np.testing.assert_allclose(fitted(line[[0, 70]], tolerance), line[[0, 70]], atol=1e-12)


def wave() -> np.ndarray:
    t = np.linspace(0, 3, 200)
    return np.column_stack([0.1 * t, 0.02 * np.sin(3 * t), np.zeros(200)])


def off(line: np.ndarray, few: np.ndarray) -> np.ndarray:
    """Distance of a line's points from a chain of straight pieces."""
    return distance_to_shapes(line, [Stem(a, b, 1e-9, "main") for a, b in itertools.pairwise(few)]).min(axis=1)


# -- evidence ---------------------------------------------------------------------------------------------------------


def test_every_point_speaks_for_the_nearest_shape() -> None:
    parts = half_sphere((0.45, 0.1, 1.1), 0.03, 0), cylinder(0.5, 0.3, 0.7, 1.4, 0.006), plane(count=3000)
    points, colors, normals = together(*parts, half_sphere((3.0, 3.0, 3.0), 0.001))  # and a speck
    found = extract_shapes(points, colors, normals)
    owner, residual = found.evidence
    assert owner.shape == residual.shape == (len(points),)
    distance = distance_to_shapes(points, found.shapes)
    explained = owner >= 0
    np.testing.assert_array_equal(explained, distance.min(axis=1) <= SETTINGS.explained)
    np.testing.assert_allclose(residual[explained], distance.min(axis=1)[explained])
    assert np.isnan(residual[~explained]).all()
    assert (owner[: len(parts[0][0])] == 0).mean() > 0.99  # the tomato comes first
    assert len(found.confidence) == len(found.tomatoes) == 1
    assert 0.9 < found.confidence[0] <= 1.0


@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_shape_is_the_one_that_distances_name(seed: int) -> None:
    random = np.random.default_rng(seed)
    points = random.uniform(-0.3, 0.3, (500, 3))
    boxes = [bounding_box(random.uniform(-0.1, 0.1, (9, 3)) + random.uniform(-0.2, 0.2, 3)) for _ in range(5)]
    balls = [Sphere(random.uniform(-0.2, 0.2, 3), 0.05) for _ in range(5)]
    owner, residual = nearest_shapes(points, [*boxes, *balls], 0.05)
    distance = distance_to_shapes(points, [*boxes, *balls])
    np.testing.assert_array_equal(owner, np.where(distance.min(axis=1) <= 0.05, distance.argmin(axis=1), -1))
    assert 0 < np.count_nonzero(owner >= 0) < len(owner)
    np.testing.assert_allclose(residual[owner >= 0], distance.min(axis=1)[owner >= 0])


# -- colors -----------------------------------------------------------------------------------------------------------


def as_surface(colors: np.ndarray, bends: tuple[float, float] = (0.0, 0.0), leaf: float = NO_LEAF) -> SurfaceCloud:
    """Points of some colors that all bend alike, among leaves of one redness."""
    nothing = np.zeros((len(colors), 3))
    return SurfaceCloud(
        nothing, colors, nothing, np.tile(bends, (len(colors), 1)), nothing[:, 0], redness(colors), leaf, 0.01
    )


def test_leaves_gutters_and_strings_are_neither_fruit_nor_stem() -> None:
    plant = np.array([*Palette().fruit, [0.36, 0.50, 0.22]])
    other = np.array([[0.20, 0.42, 0.16], [0.90, 0.90, 0.88], [0.85, 0.84, 0.78]])
    cloud = as_surface(np.concatenate([plant, other]), leaf=-0.36)
    assert (
        could_be_fruit(cloud, SETTINGS).tolist() == could_be_stem(cloud, SETTINGS).tolist() == [True] * 5 + [False] * 3
    )
    assert could_be_fruit(as_surface(np.full((4, 3), 0.5)), SETTINGS).all()  # no colors at all
    assert len(could_be_fruit(as_surface(np.zeros((0, 3))), SETTINGS)) == 0


@pytest.mark.parametrize(
    ("bends", "fruit", "stem"), [((0, 3), 0, 0), ((30, 35), 1, 1), ((0, 120), 0, 1), ((-9, 9), 0, 0)]
)
def test_what_bends_like_fruit_or_stem_may_be_such_in_the_color_of_leaves(
    bends: tuple[float, float], fruit: bool, stem: bool
) -> None:
    cloud = as_surface(np.array([[0.3, 0.4, 0.2]]), bends, leaf=-0.14)
    assert could_be_fruit(cloud, SETTINGS).tolist() == [fruit]
    assert could_be_stem(cloud, SETTINGS).tolist() == [stem]


def test_bends_and_the_color_of_leaves_are_read_off_a_cloud() -> None:
    ball, stem, leaf = half_sphere((0.45, 0.2, 1.1), 0.03), cylinder(0.5, 0.5, 0.6, 1.4, 0.008), plane()
    leaf = (leaf[0] + [0.1, 1.0, 0.0], np.tile([0.24, 0.36, 0.2], (len(leaf[0]), 1)), leaf[2])
    cloud = look_at_surfaces(Cloud(*together(ball, stem, leaf)), SETTINGS)
    kind = np.repeat([0, 1, 2], [len(part[0]) for part in (ball, stem, leaf)])
    of_ball, of_stem, of_leaf = (np.median(cloud.bends[kind == k], axis=0) for k in range(3))
    np.testing.assert_allclose(of_ball, 1 / 0.03, rtol=0.35)
    assert abs(of_stem[0]) < 0.1 * of_stem[1]
    assert of_stem[1] > 60
    assert np.abs(of_leaf).max() < 5
    assert cloud.leaf == pytest.approx(-0.2, abs=0.01)


# -- clutter ----------------------------------------------------------------------------------------------------------


def test_boxes_cover_big_pieces_within_their_margin() -> None:
    points, colors, normals = together(plane(), half_sphere((0.4, 0.8, 1.1), 0.08))  # too large for a tomato
    shapes = extract_shapes(points, colors, normals)
    assert shapes.tomatoes == ()
    # the cloud is thinned out to 3 mm before, so a point may stick out by that much more
    assert distance_to_shapes(points, shapes.clutter).min(axis=1).max() < SETTINGS.clutter_near + 0.003
    volume = sum(8 * np.prod(box.half_extents) for box in shapes.clutter)
    assert volume < 4 * (0.4 * 0.4 * 0.02 + 0.16**3 / 2)


@pytest.mark.parametrize("budget", [1, 2, 5, 40])
def test_cover_keeps_its_budget_and_holds_all_points(budget: int) -> None:
    random = np.random.default_rng(0)
    points = random.normal(0, 0.003, (3000, 3)) + random.uniform(0, 0.5, (1, 3)) * np.linspace(0, 1, 3000)[:, None]
    boxes = cover(points, np.tile([-1.0, 0.0, 0.0], (3000, 1)), budget, SETTINGS)
    assert 1 <= len(boxes) <= budget + 1
    if budget == 40:
        assert distance_to_shapes(points, boxes).min(axis=1).max() < SETTINGS.clutter_near + SETTINGS.clutter_cell


def test_more_boxes_claim_less() -> None:
    bent = np.column_stack([np.cos(t := np.linspace(0, np.pi, 4000)), np.sin(t), 0 * t]) * 0.2
    normals = bent / np.linalg.norm(bent, axis=1, keepdims=True)
    bent += np.random.default_rng(0).normal(0, 0.002, bent.shape)
    volumes = [sum(8 * np.prod(b.half_extents) for b in cover(bent, normals, n, SETTINGS)) for n in (1, 4, 16)]
    assert volumes[2] < volumes[1] < 0.25 * volumes[0]


def test_fine_shapes_claim_less_of_a_bent_leaf() -> None:
    angle, along = (g.ravel() for g in np.meshgrid(np.linspace(0, 2.5, 150), np.linspace(0, 0.12, 60)))
    normals = -np.column_stack([np.cos(angle), 0 * angle, np.sin(angle)])
    points = [0.5, 0.0, 1.0] + 0.06 * normals + along[:, None] * [0.0, 1.0, 0.0]
    points += np.random.default_rng(0).normal(0, 0.0005, points.shape)
    colors = np.tile([0.15, 0.35, 0.2], (len(points), 1))
    coarse, fine = (extract_shapes(points, colors, normals, settings) for settings in (SETTINGS, FINE_SHAPES))
    assert coarse.tomatoes == fine.tomatoes == ()
    assert len(fine.clutter) > len(coarse.clutter)
    volumes = [sum(8 * np.prod(box.half_extents) for box in shapes.clutter) for shapes in (coarse, fine)]
    assert volumes[1] < 0.8 * volumes[0]


@pytest.mark.parametrize("noise", [0.001, 0.0025, 0.003])
def test_noisy_skin_of_a_fruit_gets_no_box(noise: float) -> None:
    for seed in range(4):  # a rig farther back makes skins this thick
        points, colors, normals = half_sphere((0.5, 0.1, 1.1), 0.028, seed, noise)
        shapes = extract_shapes(points, colors, normals)
        assert len(shapes.tomatoes) == 1
        assert shapes.clutter == ()


def test_a_leaf_right_before_a_fruit_keeps_its_box() -> None:
    fruit, leaf = half_sphere((0.5, 0.2, 1.1), 0.028), plane()
    near = (leaf[0] * [1, 0.25, 0.25] + [-0.05, 0.15, 0.825], np.tile([0.24, 0.36, 0.2], (len(leaf[0]), 1)), leaf[2])
    shapes = extract_shapes(*together(fruit, near))
    assert distance_to_shapes(near[0], shapes.clutter).min(axis=1).max() < SETTINGS.clutter_near + 0.003


def test_the_boxes_of_a_leaf_that_is_curled_around_a_fruit_leave_it_clear() -> None:
    held, covered = [], []
    for seed in range(6):
        random = np.random.default_rng(seed)
        fruit = half_sphere((0.5, 0.2, 1.1), 0.02, seed)[0]
        angle, along = random.uniform(-1.7, 1.7, 1500), random.uniform(-0.01, 0.01, 1500)
        normals = np.column_stack([-np.cos(angle), np.sin(angle), 0 * angle])
        leaf = [0.5, 0.2, 1.1] + 0.026 * normals + along[:, None] * [0.0, 0.0, 1.0]
        leaf += random.normal(0, 0.001, leaf.shape)
        kept = [cover(leaf, normals, 1, SETTINGS), *(cover(leaf, normals, n, SETTINGS, fruit) for n in (1, 20))]
        held.append([(distance_to_shapes(fruit, boxes).min(axis=1) < -0.001).mean() for boxes in kept])
        covered.append([(distance_to_shapes(leaf, b).min(axis=1) < SETTINGS.clutter_near).mean() for b in kept])
    regardless, one, many = np.mean(held, axis=0)
    assert regardless > 0.5  # one box around the leaf holds most of the fruit
    assert one < 0.2
    assert many < 0.02
    assert np.mean(covered, axis=0).min() > 0.96


def test_foliage_gets_boxes_by_its_area() -> None:
    leaves = np.concatenate([plane(seed)[0] + [0, 0, 0.5 * seed] for seed in range(4)])  # one above the other
    budgets = [box_budget(leaves[: 20_000 * count], SETTINGS) for count in (1, 2, 4)]
    np.testing.assert_allclose(np.divide(budgets, budgets[0]), [1, 2, 4], rtol=0.05)
    assert box_budget(leaves[:1], SETTINGS) > 0


def test_two_leaves_that_cross_get_a_thin_box_each() -> None:
    random = np.random.default_rng(0)
    flat = random.uniform(-0.05, 0.05, (3000, 3)) * [0, 1, 1]
    upright = random.uniform(-0.05, 0.05, (3000, 3)) * [1, 1, 0]
    points = np.concatenate([flat, upright]) + random.normal(0, 0.0005, (6000, 3))
    boxes = cover(points, np.repeat([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], 3000, axis=0), 20, SETTINGS)
    assert len(boxes) <= 6
    assert (
        sum(8 * np.prod(box.half_extents) for box in boxes) < 0.3 * 0.1**3
    )  # one box around both would hold all of it


@pytest.mark.parametrize("count", [1, 2, 3, 50])
def test_a_bounding_box_holds_its_points(count: int) -> None:
    points = np.random.default_rng(count).uniform(-0.1, 0.1, (count, 3))
    assert distance_to_shapes(points, [bounding_box(points)]).max() < 1e-9
    assert distance_to_shapes(np.repeat(points[:1], 4, axis=0), [bounding_box(points)]).max() < 1e-9


# -- what is no row ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 2, 3, 10, 49])
def test_few_points_hold_nothing(count: int) -> None:
    points = np.random.default_rng(0).uniform(0, 1, (count, 3))
    with pytest.warns(ShapeWarning, match=f"{count} points, too few"):
        shapes = extract_shapes(points, np.full((count, 3), 0.5))
    assert (shapes.tomatoes, shapes.stems, shapes.clutter) == ((), (), ())
    assert len(shapes.warnings) == 1


def test_equal_points_hold_nothing() -> None:
    points = np.tile([0.5, 0.2, 1.1], (500, 1))
    for normals in (None, np.tile([-1.0, 0.0, 0.0], (500, 1))):
        shapes = extract_shapes(points, np.full((500, 3), 0.5), normals)
        assert shapes.tomatoes == ()
        assert shapes.stems == ()
        assert_nothing_swallows(shapes, points)


@pytest.mark.parametrize("with_normals", [True, False])
def test_a_plane_is_clutter(with_normals: bool) -> None:
    points, colors, normals = plane()
    shapes = extract_shapes(points, colors, normals if with_normals else None)
    assert shapes.tomatoes == ()
    assert shapes.stems == ()
    assert_nothing_swallows(shapes, points)
    assert sum(8 * np.prod(box.half_extents) for box in shapes.clutter) < 0.4 * 0.4 * 0.03


@pytest.mark.parametrize("seed", range(3))
def test_noise_holds_no_fruit(seed: int) -> None:
    random = np.random.default_rng(seed)
    points = random.uniform([0.3, 0.0, 0.8], [0.6, 0.5, 1.4], (20_000, 3))
    normals = random.normal(size=(20_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    shapes = extract_shapes(points, random.random((20_000, 3)), normals)
    assert shapes.tomatoes == ()
    assert_nothing_swallows(shapes, points)


def test_a_line_of_points_does_no_harm() -> None:
    points = np.column_stack([np.full(500, 0.5), np.linspace(0, 0.5, 500), np.full(500, 1.0)])
    shapes = extract_shapes(points, np.full((500, 3), 0.5))
    assert shapes.tomatoes == ()
    assert_nothing_swallows(shapes, points)


@pytest.mark.parametrize("which", ["points", "colors", "normals"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_refused(which: str, bad: float) -> None:
    arrays = dict(zip(("points", "colors", "normals"), half_sphere((0.45, 0.2, 1.1), 0.03), strict=True))
    arrays[which][7, 1] = bad
    with pytest.raises(InvalidValueError, match=rf"{which} must be finite, 1 rows"):
        extract_shapes(**arrays)


@pytest.mark.parametrize("which", ["colors", "normals"])
def test_arrays_must_fit_together(which: str) -> None:
    arrays = dict(zip(("points", "colors", "normals"), half_sphere((0.45, 0.2, 1.1), 0.03), strict=True))
    arrays[which] = arrays[which][:-1]
    with pytest.raises(InvalidValueError, match=which):
        extract_shapes(**arrays)
    with pytest.raises(InvalidValueError, match="points"):
        extract_shapes(arrays["points"][:, :2], arrays["points"])


@pytest.mark.parametrize("scale", [1000.0, 100.0])
def test_millimetres_and_centimetres_are_refused(scale: float) -> None:
    points, colors, normals = together(
        cylinder(0.5, 0.2, 0.6, 1.5, 0.006), half_sphere((0.47, 0.22, 1.1), 0.03), plane(count=5000)
    )
    with pytest.raises(InvalidValueError, match="metres"):
        extract_shapes(scale * points, colors, normals)


def test_stray_points_far_away() -> None:
    parts = plane(count=5000), half_sphere((0.4, 0.2, 1.1), 0.03)

    def stray(place: list[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return np.array([place]), np.full((1, 3), 0.5), np.array([[-1.0, 0.0, 0.0]])

    alone = extract_shapes(*together(*parts))
    assert alone.warnings == ()
    for place in ([10.0, 15.0, 9.0], [0.4, 90.0, 1.0], [1e6, -1e6, 1e6]):
        with pytest.warns(ShapeWarning, match="1 stray points"):
            shapes = extract_shapes(*together(*parts, stray(place)))
        assert len(shapes.tomatoes) == 1
        assert len(shapes.clutter) == len(alone.clutter)
        assert len(shapes.evidence.owner) == len(alone.evidence.owner) + 1


def sides(radius: float = 0.03) -> tuple[np.ndarray, np.ndarray]:
    """Four balls before a wall, points and colors, seen from the camera's side."""
    parts = [half_sphere((0.45, 0.1 + 0.08 * k, 1.1 + 0.02 * k), radius, k) for k in range(4)]
    behind = plane(count=5000)
    behind[0][:, 0] += 0.06
    points, colors, _ = together(*parts, behind)
    return points, colors


@pytest.mark.parametrize("turn", [[1, 1, 1], [-1, 1, 1], [-1, -1, 1]])
def test_without_normals_it_does_not_matter_from_where_a_cloud_was_seen(turn: list[int]) -> None:
    points, colors = sides()
    shapes = extract_shapes(points * turn, colors)
    assert len(shapes.tomatoes) == 4
    centers = np.array([t.center for t in shapes.tomatoes]) * turn
    near = np.linalg.norm(centers[:, None] - [[0.45, 0.1 + 0.08 * k, 1.1 + 0.02 * k] for k in range(4)], axis=-1)
    assert near.min(axis=1).max() < 0.003


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_zero_normals_are_estimated_and_said(share: float) -> None:
    points, colors, normals = together(*[half_sphere((0.45, 0.1 + 0.08 * k, 1.1), 0.03, k) for k in range(3)])
    normals[np.random.default_rng(0).random(len(normals)) < share] = 0.0
    with pytest.warns(ShapeWarning, match="are zero"):
        assert len(extract_shapes(points, colors, normals).tomatoes) == 3


def test_a_cloud_that_lies_on_its_side_is_said_to() -> None:
    points, colors, normals = cylinder(0.5, 0.2, 0.6, 1.5, 0.006)
    with pytest.warns(ShapeWarning, match="z must be up"):
        shapes = extract_shapes(points[:, [0, 2, 1]], colors, normals[:, [0, 2, 1]])
    assert shapes.warnings


def test_the_edge_of_a_table_is_no_stem_that_lies() -> None:
    points, _, normals = cylinder(0.5, 0.2, 0.6, 1.5, 0.006)
    brown = np.tile([0.50, 0.36, 0.22], (len(points), 1))
    assert not extract_shapes(points[:, [0, 2, 1]], brown, normals[:, [0, 2, 1]]).warnings


@pytest.mark.parametrize(("long", "fewest", "off"), [(0.026, 8, 0.03), (0.031, 7, 0.08)])
def test_plum_fruit_becomes_ellipsoids_of_its_length(long: float, fewest: int, off: float) -> None:
    semi_axes = np.array([0.020, 0.020, long])
    centers = [(0.45 + 0.005 * (k % 2), 0.1 + 0.07 * k, 1.1) for k in range(8)]
    parts = []
    for k, center in enumerate(centers):
        points, colors, _ = half_sphere(center, 0.020, k)
        unit = (points - center) / 0.020
        normals = unit / semi_axes / np.linalg.norm(unit / semi_axes, axis=1, keepdims=True)
        parts.append((center + unit * semi_axes, colors, normals))
    shapes = extract_shapes(*together(*parts))
    assert fewest <= len(shapes.tomatoes) <= len(centers)
    places = [int(np.linalg.norm(np.array(centers) - t.center, axis=1).argmin()) for t in shapes.tomatoes]
    assert len(set(places)) == len(places), "the ends of a long fruit are not two"
    for tomato in shapes.tomatoes:
        assert isinstance(tomato.shape, Ellipsoid)
        np.testing.assert_allclose(np.sort(tomato.shape.semi_axes), semi_axes, rtol=off)
        assert abs(tomato.shape.rotation[2, int(np.argmax(tomato.shape.semi_axes))]) > 0.97
        assert np.linalg.norm(np.array(centers) - tomato.center, axis=1).min() < 0.0035


def test_round_fruit_stays_round() -> None:
    parts = [half_sphere((0.45, 0.1 + 0.07 * k, 1.1), 0.025, k) for k in range(8)]
    assert [type(tomato.shape) for tomato in extract_shapes(*together(*parts)).tomatoes] == [Sphere] * 8


def test_colors_of_bytes_are_refused() -> None:
    points, colors, normals = half_sphere((0.45, 0.2, 1.1), 0.03)
    with pytest.raises(InvalidValueError, match="colors must be between 0 and 1"):
        extract_shapes(points, 255 * colors, normals)


# -- a simulated row --------------------------------------------------------------------------------------------------


@pytest.mark.xdist_group("row")
def test_tomatoes_of_a_simulated_row_against_the_truth() -> None:
    cloud, recording, row = full_cloud(), full_recording(), grown()
    shapes = extract_shapes(cloud.points, cloud.colors, cloud.normals)
    poses = true_poses(recording)
    centers = transform(invert(poses[0]), np.array([t.center for t in row.tomatoes]))
    true = [Tomato(Sphere(c, t.radius), t.truss, t.ripeness) for c, t in zip(centers, row.tomatoes, strict=True)]
    visible = visible_tomatoes(row, recording.rig, poses)
    matches = match_tomatoes(true, shapes.tomatoes)
    assert visible.sum() > 15
    assert visible[matches.true].sum() >= 0.75 * visible.sum()
    assert len(matches.found) >= 0.9 * len(shapes.tomatoes)
    assert np.median(matches.center_errors) < 0.004
    assert np.median(matches.diameter_errors) < 0.06
    ripeness = [(true[i].ripeness, shapes.tomatoes[j].ripeness) for i, j in zip(*matches[:2], strict=True)]
    assert np.median([abs(a - b) for a, b in ripeness if a is not None and b is not None]) < 0.15
    assert {stem.kind for stem in shapes.stems} >= {"main", "peduncle"}
    assert_nothing_swallows(shapes, cloud.points)
    for tomato in shapes.tomatoes:  # the truth and the found have one frame
        assert isinstance(tomato.shape, Sphere)
    again = extract_shapes(cloud.points, cloud.colors, cloud.normals)
    assert [t.center.tolist() for t in again.tomatoes] == [t.center.tolist() for t in shapes.tomatoes]


def test_matching_is_one_to_one_within_a_radius() -> None:
    true = [Tomato(Sphere([0, 0.1 * k, 1], 0.03), truss=0) for k in range(3)]
    found = [
        Tomato(Sphere([0, 0.201, 1], 0.033), truss=0),
        Tomato(Sphere([0, 0.01, 1], 0.03), truss=0),
        Tomato(Sphere([0, 0.02, 1], 0.03), truss=0),
    ]
    matches = match_tomatoes(true, found)
    np.testing.assert_array_equal(matches.true, [0, 2])
    np.testing.assert_array_equal(matches.found, [1, 0])
    np.testing.assert_allclose(matches.center_errors, [0.01, 0.001])
    np.testing.assert_allclose(matches.diameter_errors, [0.0, 0.1])
    assert len(match_tomatoes(true, []).true) == len(match_tomatoes([], found).true) == 0
