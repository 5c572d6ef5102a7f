from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from greenhouse_gym.errors import GreenhouseError, InvalidValueError
from greenhouse_gym.geometry import (
    Box,
    Capsule,
    Ellipsoid,
    Shape,
    Sphere,
    arrays_of,
    bounding_balls,
    closest_on_segments,
    distance_to_boxes,
    distance_to_capsules,
    distance_to_ellipsoids,
    distance_to_nearest,
    distance_to_shapes,
    distance_to_spheres,
    frame_along,
    invert,
    is_rotation,
    pose,
    rotation_about,
    rotation_angle,
    transform,
)

coordinate = st.floats(-3.0, 3.0)
size = st.floats(0.01, 1.0)
vectors = arrays(np.float64, 3, elements=coordinate)
clouds = arrays(np.float64, (7, 3), elements=coordinate)
directions = vectors.filter(lambda v: np.linalg.norm(v) > 1e-3)
angles = st.floats(-np.pi, np.pi)
rotations = st.builds(rotation_about, directions, angles)
poses = st.builds(pose, rotations, vectors)
spheres = st.builds(Sphere, vectors, size)
capsules = st.builds(Capsule, vectors, vectors, size)
boxes = st.builds(Box, vectors, arrays(np.float64, 3, elements=size), rotations)
shapes = st.one_of(spheres, capsules, boxes)


def distance(points: np.ndarray, shape: Shape) -> np.ndarray:
    return distance_to_shapes(points, [shape])[:, 0]


def surface_points(shape: Shape, count: int, seed: int = 0) -> np.ndarray:
    """Points exactly on a shape's surface, spread over all of it."""
    random = np.random.default_rng(seed)
    if isinstance(shape, Box):
        local = random.uniform(-1, 1, (count, 3))
        face = random.integers(0, 3, count)
        local[np.arange(count), face] = random.choice([-1.0, 1.0], count)
        return shape.center + (local * shape.half_extents) @ shape.rotation.T
    unit = random.normal(size=(count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    if isinstance(shape, Sphere):
        return shape.center + shape.radius * unit
    axis = shape.end - shape.start
    along = axis / max(np.linalg.norm(axis), 1e-12)
    height = random.uniform(0, 1, (count, 1))
    end = np.where((unit @ along > 0)[:, None], shape.end, shape.start)
    around = unit - (unit @ along)[:, None] * along
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    on_side = (random.random(count) < 0.5)[:, None] & (np.linalg.norm(axis) > 1e-9)
    return np.where(on_side, shape.start + height * axis + shape.radius * around, end + shape.radius * unit)


# -- poses ------------------------------------------------------------------------------------------------------------


@given(poses)
def test_inverting_twice_gives_the_pose(t: np.ndarray) -> None:
    np.testing.assert_allclose(invert(invert(t)), t, atol=1e-12)
    np.testing.assert_allclose(invert(t) @ t, np.eye(4), atol=1e-11)
    np.testing.assert_allclose(invert(t), np.linalg.inv(t), atol=1e-9)


@given(poses, poses, clouds)
def test_transforms_compose(a: np.ndarray, b: np.ndarray, points: np.ndarray) -> None:
    np.testing.assert_allclose(transform(a @ b, points), transform(a, transform(b, points)), atol=1e-11)
    np.testing.assert_allclose(transform(invert(a), transform(a, points)), points, atol=1e-11)


@given(poses, clouds)
def test_transforms_keep_distances(t: np.ndarray, points: np.ndarray) -> None:
    moved = transform(t, points)
    before, after = (np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (points, moved))
    np.testing.assert_allclose(after, before, atol=1e-10)


@given(st.lists(poses, min_size=1, max_size=4))
def test_a_stack_of_poses_is_inverted_one_by_one(stack: list[np.ndarray]) -> None:
    np.testing.assert_array_equal(invert(np.array(stack)), [invert(t) for t in stack])


@given(directions, angles)
def test_rotation_angle_undoes_rotation_about(axis: np.ndarray, angle: float) -> None:
    turn = rotation_about(axis, angle)
    assert is_rotation(turn, tolerance=1e-9)
    assert rotation_angle(turn) == pytest.approx(abs(angle), abs=1e-8)
    np.testing.assert_allclose(turn @ axis, axis, atol=1e-9)
    np.testing.assert_allclose(rotation_about(axis, -angle), turn.T, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-6, np.pi - 1e-6, np.pi])
def test_rotation_angle_is_exact_at_its_ends(angle: float) -> None:
    assert rotation_angle(rotation_about([1.0, 2.0, -0.5], angle)) == pytest.approx(angle, abs=1e-14, rel=1e-6)


def test_rotation_about_turns_counterclockwise() -> None:
    np.testing.assert_allclose(rotation_about([0, 0, 5], np.pi / 2) @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(rotation_about([1, 0, 0], np.pi / 2) @ [0, 1, 0], [0, 0, 1], atol=1e-15)


@given(directions)
def test_frame_along_has_the_direction_as_third_column(direction: np.ndarray) -> None:
    frame = frame_along(direction)
    assert is_rotation(frame, tolerance=1e-9)
    np.testing.assert_allclose(frame[:, 2], direction / np.linalg.norm(direction), atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_frame_along_an_axis(axis: int, sign: float) -> None:
    assert is_rotation(frame_along(sign * np.eye(3)[axis]), tolerance=1e-12)


@pytest.mark.parametrize(
    "matrix",
    [np.diag([1.0, 1.0, -1.0]), 1.01 * np.eye(3), np.full((3, 3), np.nan), np.eye(4), np.zeros((3, 3)), np.eye(3)[:2]],
)
def test_what_is_no_rotation(matrix: np.ndarray) -> None:
    assert not is_rotation(matrix)


def test_pose_parts_default_to_identity() -> None:
    np.testing.assert_array_equal(pose(), np.eye(4))
    np.testing.assert_array_equal(pose(translation=[1, 2, 3])[:3, 3], [1, 2, 3])
    np.testing.assert_array_equal(pose(2 * np.eye(3))[:3, :3], 2 * np.eye(3))


# -- distances --------------------------------------------------------------------------------------------------------


@given(shapes)
def test_points_on_the_surface_have_distance_zero(shape: Shape) -> None:
    np.testing.assert_allclose(distance(surface_points(shape, 60), shape), 0.0, atol=1e-9)


@given(shapes, clouds, clouds)
def test_distance_never_changes_faster_than_the_point_moves(shape: Shape, a: np.ndarray, b: np.ndarray) -> None:
    moved = np.linalg.norm(a - b, axis=1)
    assert (np.abs(distance(a, shape) - distance(b, shape)) <= moved + 1e-9).all()


@given(shapes, clouds)
def test_distance_agrees_with_dense_samples_of_the_surface(shape: Shape, points: np.ndarray) -> None:
    samples = surface_points(shape, 4000, seed=1)
    nearest = np.linalg.norm(points[:, None] - samples[None], axis=-1).min(axis=1)
    signed = distance(points, shape)
    reach = np.ptp(samples, axis=0).max()
    assert (nearest >= np.abs(signed) - 1e-9).all()
    assert (nearest <= np.abs(signed) + 0.2 * reach).all()


@given(shapes, clouds, poses)
def test_distance_does_not_depend_on_the_frame(shape: Shape, points: np.ndarray, t: np.ndarray) -> None:
    turn = t[:3, :3]

    def move(p: np.ndarray) -> np.ndarray:
        return transform(t, p[None])[0]

    if isinstance(shape, Box):
        moved: Shape = Box(move(shape.center), shape.half_extents, turn @ shape.rotation)
    elif isinstance(shape, Capsule):
        moved = Capsule(move(shape.start), move(shape.end), shape.radius)
    else:
        moved = Sphere(move(shape.center), shape.radius)
    np.testing.assert_allclose(distance(transform(t, points), moved), distance(points, shape), atol=1e-9)


@given(boxes, clouds)
def test_box_distance_against_brute_force(box: Box, points: np.ndarray) -> None:
    """The projection onto the box outside; inside, the nearest of the six faces' planes."""
    local = (points - box.center) @ box.rotation
    nearest = np.clip(local, -box.half_extents, box.half_extents)
    outside = np.linalg.norm(local - nearest, axis=1)
    planes = np.concatenate([box.half_extents - local, box.half_extents + local], axis=1)
    expected = np.where(outside > 0, outside, -planes.min(axis=1))
    np.testing.assert_allclose(distance(points, box), expected, atol=1e-9)


@given(vectors, vectors, size, clouds)
def test_capsule_distance_against_dense_samples_of_its_axis(
    start: np.ndarray, end: np.ndarray, radius: float, points: np.ndarray
) -> None:
    axis = start + np.linspace(0, 1, 2001)[:, None] * (end - start)
    expected = np.linalg.norm(points[:, None] - axis[None], axis=-1).min(axis=1) - radius
    actual = distance(points, Capsule(start, end, radius))
    assert (actual <= expected + 1e-9).all()
    np.testing.assert_allclose(actual, expected, atol=np.linalg.norm(end - start) / 2000 + 1e-9)


@given(vectors, size, clouds)
def test_a_capsule_without_length_is_a_sphere(center: np.ndarray, radius: float, points: np.ndarray) -> None:
    capsule = Capsule(center, center, radius)
    assert capsule.length == 0.0
    np.testing.assert_allclose(distance(points, capsule), distance(points, Sphere(center, radius)), atol=1e-12)
    nearly = Capsule(center, center + 1e-12, radius)
    np.testing.assert_allclose(distance(points, nearly), distance(points, capsule), atol=1e-9)


@given(vectors, vectors, clouds)
def test_closest_on_segments_lies_on_the_segment(start: np.ndarray, end: np.ndarray, points: np.ndarray) -> None:
    nearest = closest_on_segments(points, start, end)[:, 0]
    detour = np.linalg.norm(nearest - start, axis=1) + np.linalg.norm(nearest - end, axis=1)
    np.testing.assert_allclose(detour, np.linalg.norm(end - start), atol=1e-9)


@given(st.lists(shapes, max_size=6), st.integers(1, 20))
def test_a_mixed_list_gives_each_shape_its_column(mixed: list[Shape], chunk: int) -> None:
    points = np.random.default_rng(0).uniform(-3, 3, (20, 3))
    with patch("greenhouse_gym.geometry.distances._CHUNK", chunk):
        result = distance_to_shapes(points, mixed)
    assert result.shape == (20, len(mixed))
    for column, shape in zip(result.T, mixed, strict=True):
        if isinstance(shape, Sphere):
            own = distance_to_spheres(points, shape.center, shape.radius)
        elif isinstance(shape, Capsule):
            own = distance_to_capsules(points, shape.start, shape.end, shape.radius)
        else:
            own = distance_to_boxes(points, shape.center, shape.half_extents, shape.rotation)
        np.testing.assert_allclose(column, own[:, 0], atol=1e-12)


@settings(deadline=None)  # the first example compiles a kernel
@given(st.lists(shapes, max_size=6), st.floats(0.0, 1.0), clouds)
def test_the_nearest_of_some_shapes_is_exact_up_to_a_limit(
    mixed: list[Shape], limit: float, points: np.ndarray
) -> None:
    nearest = distance_to_nearest(points, mixed, limit)
    expected = distance_to_shapes(points, mixed).min(axis=1, initial=np.inf)
    within = expected <= limit
    np.testing.assert_allclose(nearest[within], expected[within], atol=1e-12)
    assert (nearest[~within] > limit - 1e-12).all()
    np.testing.assert_array_equal(nearest, distance_to_nearest(points, arrays_of(mixed), limit))


@given(shapes)
def test_a_ball_holds_its_shape(shape: Shape) -> None:
    centers, radii = bounding_balls([shape])
    assert (np.linalg.norm(surface_points(shape, 200) - centers, axis=1) <= radii + 1e-9).all()


def test_a_ball_holds_an_ellipsoid() -> None:
    centers, radii = bounding_balls([Ellipsoid([0.1, 0.2, 0.3], [0.025, 0.03, 0.036], np.eye(3))])
    assert (centers.tolist(), radii.tolist()) == ([[0.1, 0.2, 0.3]], [0.036])


def test_distances_of_no_points() -> None:
    assert distance_to_shapes(np.zeros((0, 3)), [Sphere([0, 0, 0], 1.0)]).shape == (0, 1)
    assert distance_to_shapes(np.zeros((4, 3)), []).shape == (4, 0)


# -- shapes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [0.0, -0.1, np.nan, np.inf])
def test_radii_must_be_positive(radius: float) -> None:
    with pytest.raises(InvalidValueError, match="radius"):
        Sphere([0, 0, 0], radius)
    with pytest.raises(InvalidValueError, match="radius"):
        Capsule([0, 0, 0], [0, 0, 1], radius)


@pytest.mark.parametrize("center", [[0, 0], [0, 0, np.nan], [[0, 0, 0]], ["a", "b", "c"], None, [np.inf, 0, 0]])
def test_centers_must_be_three_finite_numbers(center: object) -> None:
    with pytest.raises(GreenhouseError):
        Sphere(center, 0.1)  # type: ignore[arg-type]


def test_boxes_must_be_turned_and_thick() -> None:
    with pytest.raises(InvalidValueError, match="half_extents"):
        Box([0, 0, 0], [0.1, 0.0, 0.1], np.eye(3))
    with pytest.raises(InvalidValueError, match="rotation"):
        Box([0, 0, 0], [0.1, 0.1, 0.1], np.diag([1.0, 1.0, -1.0]))


def test_shapes_cannot_be_changed_from_outside() -> None:
    center = np.zeros(3)
    ball = Sphere(center, 0.1)
    center += 1.0
    np.testing.assert_array_equal(ball.center, 0.0)
    with pytest.raises(ValueError, match="read-only"):
        ball.center[0] = 1.0


axes = arrays(np.float64, 3, elements=st.floats(0.01, 0.3))


@given(vectors, axes, rotations, st.integers(0, 100))
def test_points_off_an_ellipsoid_along_its_normals_are_as_far_as_they_were_moved(
    center: np.ndarray, semi_axes: np.ndarray, rotation: np.ndarray, seed: int
) -> None:
    random = np.random.default_rng(seed)
    unit = random.normal(size=(50, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    normal = unit / semi_axes
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # inwards only as far as the least radius of curvature, where the surface point is still the nearest
    moved = random.uniform(-0.99 * semi_axes.min() ** 2 / semi_axes.max(), 1.0, 50)
    points = center + (unit * semi_axes + moved[:, None] * normal) @ rotation.T
    np.testing.assert_allclose(
        distance_to_ellipsoids(points, center, semi_axes, rotation)[:, 0], moved, atol=2e-6 * semi_axes.max()
    )


@given(clouds, vectors, size, rotations)
def test_an_ellipsoid_of_equal_axes_is_a_sphere(
    points: np.ndarray, center: np.ndarray, radius: float, rotation: np.ndarray
) -> None:
    ball = distance_to_spheres(points, center[None], [radius])
    np.testing.assert_allclose(
        distance_to_ellipsoids(points, center, np.full(3, radius), rotation), ball, atol=1e-6 * radius
    )


def test_the_middle_of_an_ellipsoid_is_its_least_semi_axis_deep() -> None:
    found = distance_to_ellipsoids([[0.0, 0.0, 0.0], [0.0, 0.0, 0.01]], np.zeros(3), [0.03, 0.02, 0.05], np.eye(3))
    np.testing.assert_allclose(found[0, 0], -0.02, atol=1e-7)
    assert -0.02 < found[1, 0] < -0.019


@pytest.mark.parametrize(
    ("axes", "turn", "message"),
    [
        ([0.1, 0.1, 0.0], np.eye(3), "semi_axes"),
        ([0.1, 0.1], np.eye(3), "shape"),
        ([0.1] * 3, 2 * np.eye(3), "rotation"),
    ],
)
def test_impossible_ellipsoids_are_refused(axes: list[float], turn: np.ndarray, message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        Ellipsoid([0, 0, 0], axes, turn)


@pytest.mark.parametrize("axis", [[0.0, 0.0, 0.0], [np.nan, 0.0, 1.0], [1.0, 0.0]])
def test_a_rotation_needs_an_axis_with_a_direction(axis: list[float]) -> None:
    with pytest.raises(InvalidValueError, match="rotation_about: expected an axis"):
        rotation_about(axis, 0.5)
