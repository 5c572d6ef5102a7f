"""Extraction of whole clouds: ideal shapes, hostile input, and a simulated row."""

from __future__ import annotations

import numpy as np
import pytest
from row_helpers import full_cloud, full_recording, grown, true_poses
from shape_clouds import cylinder, half_sphere, plane, together

from greenhouse_gym.accuracy import match_tomatoes, visible_tomatoes
from greenhouse_gym.crops import Palette
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box, Ellipsoid, Sphere, distance_to_shapes, invert, transform
from greenhouse_gym.shapes import RowShapes, ShapeSettings, ShapeWarning, extract_shapes
from greenhouse_gym.shapes.clutter import bounding_box
from greenhouse_gym.shapes.evidence import nearest_shapes
from greenhouse_gym.shapes.extract import EXPLAINED
from greenhouse_gym.shapes.fruit.detection import ripeness_of
from greenhouse_gym.shapes.fruit.trusses import group_trusses

SETTINGS = ShapeSettings()


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
def test_touching_balls_are_separated(apart: tuple[float, float, float]) -> None:
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


def test_a_hidden_ball_is_found_by_the_size_of_its_neighbors() -> None:
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
def test_ripeness_does_not_depend_on_brightness(ripeness: float, color: np.ndarray) -> None:
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


def test_a_ball_in_front_of_a_stem() -> None:
    shapes = extract_shapes(*together(cylinder(0.55, 0.2, 0.6, 1.5, 0.006), half_sphere((0.47, 0.22, 1.1), 0.03)))
    assert len(shapes.tomatoes) == 1
    assert {stem.kind for stem in shapes.stems} == {"main"}


# -- evidence ---------------------------------------------------------------------------------------------------------


def test_every_point_is_evidence_for_the_nearest_shape() -> None:
    parts = half_sphere((0.45, 0.1, 1.1), 0.03, 0), cylinder(0.5, 0.3, 0.7, 1.4, 0.006), plane(count=3000)
    points, colors, normals = together(*parts, half_sphere((3.0, 3.0, 3.0), 0.001))  # and a speck
    found = extract_shapes(points, colors, normals)
    owner, residual = found.evidence
    assert owner.shape == residual.shape == (len(points),)
    distance = distance_to_shapes(points, found.shapes)
    explained = owner >= 0
    np.testing.assert_array_equal(explained, distance.min(axis=1) <= EXPLAINED)
    np.testing.assert_allclose(residual[explained], distance.min(axis=1)[explained])
    assert np.isnan(residual[~explained]).all()
    assert (owner[: len(parts[0][0])] == 0).mean() > 0.99  # the tomato comes first
    assert len(found.confidence) == len(found.tomatoes) == 1
    assert 0.9 < found.confidence[0] <= 1.0


@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_shape_has_the_smallest_distance(seed: int) -> None:
    random = np.random.default_rng(seed)
    points = random.uniform(-0.3, 0.3, (500, 3))
    boxes = [Box(*bounding_box(random.uniform(-0.1, 0.1, (9, 3)) + random.uniform(-0.2, 0.2, 3))) for _ in range(5)]
    balls = [Sphere(random.uniform(-0.2, 0.2, 3), 0.05) for _ in range(5)]
    owner, residual = nearest_shapes(points, [*boxes, *balls], 0.05)
    distance = distance_to_shapes(points, [*boxes, *balls])
    np.testing.assert_array_equal(owner, np.where(distance.min(axis=1) <= 0.05, distance.argmin(axis=1), -1))
    assert 0 < np.count_nonzero(owner >= 0) < len(owner)
    np.testing.assert_allclose(residual[owner >= 0], distance.min(axis=1)[owner >= 0])


# -- what is no row ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 2, 3, 10, 49])
def test_too_few_points_give_no_shapes(count: int) -> None:
    points = np.random.default_rng(0).uniform(0, 1, (count, 3))
    with pytest.warns(ShapeWarning, match=f"{count} points, too few"):
        shapes = extract_shapes(points, np.full((count, 3), 0.5))
    assert (shapes.tomatoes, shapes.stems, shapes.clutter) == ((), (), ())
    assert len(shapes.warnings) == 1


def test_equal_points_give_no_shapes() -> None:
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
def test_noise_contains_no_fruit(seed: int) -> None:
    random = np.random.default_rng(seed)
    points = random.uniform([0.3, 0.0, 0.8], [0.6, 0.5, 1.4], (20_000, 3))
    normals = random.normal(size=(20_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    shapes = extract_shapes(points, random.random((20_000, 3)), normals)
    assert shapes.tomatoes == ()
    assert_nothing_swallows(shapes, points)


def test_a_line_of_points_contains_no_fruit() -> None:
    points = np.column_stack([np.full(500, 0.5), np.linspace(0, 0.5, 500), np.full(500, 1.0)])
    shapes = extract_shapes(points, np.full((500, 3), 0.5))
    assert shapes.tomatoes == ()
    assert_nothing_swallows(shapes, points)


@pytest.mark.parametrize("which", ["points", "colors", "normals"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_rejected(which: str, bad: float) -> None:
    arrays = dict(zip(("points", "colors", "normals"), half_sphere((0.45, 0.2, 1.1), 0.03), strict=True))
    arrays[which][7, 1] = bad
    with pytest.raises(InvalidValueError, match=rf"{which} must be finite, 1 rows"):
        extract_shapes(**arrays)


@pytest.mark.parametrize("which", ["colors", "normals"])
def test_arrays_must_have_the_same_length(which: str) -> None:
    arrays = dict(zip(("points", "colors", "normals"), half_sphere((0.45, 0.2, 1.1), 0.03), strict=True))
    arrays[which] = arrays[which][:-1]
    with pytest.raises(InvalidValueError, match=which):
        extract_shapes(**arrays)
    with pytest.raises(InvalidValueError, match="points"):
        extract_shapes(arrays["points"][:, :2], arrays["points"])


@pytest.mark.parametrize("scale", [1000.0, 100.0])
def test_millimetres_and_centimetres_are_rejected(scale: float) -> None:
    points, colors, normals = together(
        cylinder(0.5, 0.2, 0.6, 1.5, 0.006), half_sphere((0.47, 0.22, 1.1), 0.03), plane(count=5000)
    )
    with pytest.raises(InvalidValueError, match="metres"):
        extract_shapes(scale * points, colors, normals)


def test_outliers_are_ignored() -> None:
    parts = plane(count=5000), half_sphere((0.4, 0.2, 1.1), 0.03)

    def outlier(point: list[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return np.array([point]), np.full((1, 3), 0.5), np.array([[-1.0, 0.0, 0.0]])

    alone = extract_shapes(*together(*parts))
    assert alone.warnings == ()
    for point in ([10.0, 15.0, 9.0], [0.4, 90.0, 1.0], [1e6, -1e6, 1e6]):
        with pytest.warns(ShapeWarning, match="1 outliers"):
            shapes = extract_shapes(*together(*parts, outlier(point)))
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
def test_without_normals_the_viewpoint_does_not_matter(turn: list[int]) -> None:
    points, colors = sides()
    shapes = extract_shapes(points * turn, colors)
    assert len(shapes.tomatoes) == 4
    centers = np.array([t.center for t in shapes.tomatoes]) * turn
    near = np.linalg.norm(centers[:, None] - [[0.45, 0.1 + 0.08 * k, 1.1 + 0.02 * k] for k in range(4)], axis=-1)
    assert near.min(axis=1).max() < 0.003


@pytest.mark.parametrize("fraction", [0.3, 1.0])
def test_zero_normals_are_estimated_with_a_warning(fraction: float) -> None:
    points, colors, normals = together(*[half_sphere((0.45, 0.1 + 0.08 * k, 1.1), 0.03, k) for k in range(3)])
    normals[np.random.default_rng(0).random(len(normals)) < fraction] = 0.0
    with pytest.warns(ShapeWarning, match="are zero"):
        assert len(extract_shapes(points, colors, normals).tomatoes) == 3


def test_a_cloud_on_its_side_gives_a_warning() -> None:
    points, colors, normals = cylinder(0.5, 0.2, 0.6, 1.5, 0.006)
    with pytest.warns(ShapeWarning, match="z must be up"):
        shapes = extract_shapes(points[:, [0, 2, 1]], colors, normals[:, [0, 2, 1]])
    assert shapes.warnings


def test_the_edge_of_a_table_is_no_lying_stem() -> None:
    points, _, normals = cylinder(0.5, 0.2, 0.6, 1.5, 0.006)
    brown = np.tile([0.50, 0.36, 0.22], (len(points), 1))
    assert not extract_shapes(points[:, [0, 2, 1]], brown, normals[:, [0, 2, 1]]).warnings


@pytest.mark.parametrize(("long", "min_count", "tolerance"), [(0.026, 8, 0.03), (0.031, 7, 0.08)])
def test_plum_fruit_becomes_ellipsoids_of_its_length(long: float, min_count: int, tolerance: float) -> None:
    semi_axes = np.array([0.020, 0.020, long])
    centers = [(0.45 + 0.005 * (k % 2), 0.1 + 0.07 * k, 1.1) for k in range(8)]
    parts = []
    for k, center in enumerate(centers):
        points, colors, _ = half_sphere(center, 0.020, k)
        unit = (points - center) / 0.020
        normals = unit / semi_axes / np.linalg.norm(unit / semi_axes, axis=1, keepdims=True)
        parts.append((center + unit * semi_axes, colors, normals))
    shapes = extract_shapes(*together(*parts))
    assert min_count <= len(shapes.tomatoes) <= len(centers)
    nearest = [int(np.linalg.norm(np.array(centers) - t.center, axis=1).argmin()) for t in shapes.tomatoes]
    assert len(set(nearest)) == len(nearest), "the ends of a long fruit are not two"
    for tomato in shapes.tomatoes:
        assert isinstance(tomato.shape, Ellipsoid)
        np.testing.assert_allclose(np.sort(tomato.shape.semi_axes), semi_axes, rtol=tolerance)
        assert abs(tomato.shape.rotation[2, int(np.argmax(tomato.shape.semi_axes))]) > 0.97
        assert np.linalg.norm(np.array(centers) - tomato.center, axis=1).min() < 0.0035


def test_round_fruit_stays_round() -> None:
    parts = [half_sphere((0.45, 0.1 + 0.07 * k, 1.1), 0.025, k) for k in range(8)]
    assert [type(tomato.shape) for tomato in extract_shapes(*together(*parts)).tomatoes] == [Sphere] * 8


def test_colors_above_one_are_rejected() -> None:
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
    for tomato in shapes.tomatoes:
        assert isinstance(tomato.shape, Sphere)
    part = np.abs(cloud.points[:, 1] - np.median(cloud.points[:, 1])) < 0.05
    first, again = (extract_shapes(cloud.points[part], cloud.colors[part], cloud.normals[part]) for _ in range(2))
    assert [t.center.tolist() for t in again.tomatoes] == [t.center.tolist() for t in first.tomatoes] != []


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
