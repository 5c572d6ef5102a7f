from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from row_helpers import HALF

from greenhouse_gym.accuracy import (
    OCCLUSION_BANDS,
    RIPENESS_BANDS,
    StemComparison,
    TomatoComparison,
    Visibility,
    align,
    compare_stems,
    compare_tomatoes,
    coverage,
    cut,
    excess,
    match_tomatoes,
    pool_stems,
    pool_tomatoes,
    visibility,
    visible_row,
    visible_surface,
)
from greenhouse_gym.accuracy.cover import outer_samples
from greenhouse_gym.accuracy.silhouettes import Outlines
from greenhouse_gym.capture import CaptureSettings, Intrinsics
from greenhouse_gym.capture.rig import Camera, Rig
from greenhouse_gym.capture.sensor import StereoNoise
from greenhouse_gym.capture.simulated import tripod_poses
from greenhouse_gym.crops import PlantRow, grow_row
from greenhouse_gym.crops.parts import Stem, StemKind, Tomato
from greenhouse_gym.geometry import (
    Array,
    Box,
    Capsule,
    Ellipsoid,
    Shape,
    Sphere,
    distance_to_shapes,
    pose,
    rotation_about,
    transformed,
)

K = Intrinsics(160, 120, 150.0, 150.0, 79.5, 59.5)
FORWARD = np.column_stack([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
ONE_CAMERA = Rig({"only": Camera(K, pose(FORWARD, [0.0, 0.0, 1.0]))}, "only")
"""A camera at (0, 0, 1) that looks along x; image right is -y, up is z."""


def row_of(*shapes: Tomato | Shape) -> PlantRow:
    tomatoes = tuple(s for s in shapes if isinstance(s, Tomato))
    stems = tuple(s for s in shapes if isinstance(s, Stem))
    return PlantRow(tomatoes, stems, tuple(s for s in shapes if not isinstance(s, (Tomato, Stem))), 1.0, 0)


def seen(*shapes: Tomato | Shape) -> Visibility:
    """Visibility of the first shape to one camera."""
    row, first = row_of(*shapes), shapes[0]
    shape = first.shape if isinstance(first, Tomato) else first
    return visibility(row, [shape], np.array([row.shapes.index(shape)]), ONE_CAMERA, np.eye(4)[None])


def tomato(y: float, truss: int = 0, ripeness: float | None = 1.0, z: float = 1.0, radius: float = 0.03) -> Tomato:
    return Tomato(Sphere([0.5, y, z], radius), truss, ripeness)


def wall(y: float, half_width: float, x: float = 0.3) -> Box:
    """A board between the camera and what is at x = 0.5."""
    return Box([x, y, 1.0], [0.001, half_width, 0.2], np.eye(3))


# -- visibility -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "part",
    [
        tomato(0.02, z=1.03),
        Tomato(Ellipsoid([0.5, 0.02, 1.0], [0.02, 0.04, 0.08], rotation_about([1.0, 0.0, 0.0], 0.4)), 0),
        Stem([0.45, -0.02, 0.95], [0.5, 0.03, 1.05], 0.004, "main"),
        Box([0.5, 0.02, 1.0], [0.03, 0.02, 0.001], rotation_about([1, 2, 3], 0.7)),
    ],
)
def test_a_shape_alone_is_wholly_visible_and_covers_the_pixels_that_a_ray_caster_says(part: Tomato | Shape) -> None:
    shape = part.shape if isinstance(part, Tomato) else part
    alone = seen(part)
    assert alone.in_image[0] > 0.97
    assert alone.whole[0] > 0.97
    lone = Outlines.of([shape]).seen_from(np.linalg.inv(ONE_CAMERA.cameras["only"].rig_from_camera)).silhouette(0, K)
    mask = np.zeros((K.height, K.width), dtype=bool)
    mask[lone.image] = lone.covered
    rows, columns = np.mgrid[: K.height, : K.width]
    rays = np.stack([(columns - K.cx) / K.fx, (rows - K.cy) / K.fy, np.ones(rows.shape)], axis=-1) @ FORWARD.T
    along = np.linspace(0.4, 0.6, 800)
    truth = np.zeros(mask.shape, dtype=bool)
    for v, u in np.argwhere(mask | _dilated(mask)):
        points = [0.0, 0.0, 1.0] + along[:, None] * rays[v, u]
        truth[v, u] = distance_to_shapes(points, [shape]).min() < 0
    assert np.count_nonzero(mask != truth) <= 0.02 * np.count_nonzero(mask) + 1
    assert lone.whole == np.count_nonzero(mask) > 50


def _dilated(mask: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    grown = mask.copy()
    for axis in (0, 1):
        for step in (-2, -1, 1, 2):
            grown |= np.roll(mask, step, axis)
    return grown


def test_what_stands_before_hides_its_share() -> None:
    ball = tomato(0.0)
    assert seen(ball, wall(0.2, 0.2)).in_image[0] == pytest.approx(0.5, abs=0.04)
    assert seen(ball, wall(0.0, 0.2)).in_image[0] == 0.0
    assert seen(ball, wall(0.0, 0.2, x=0.7)).in_image[0] > 0.97


def test_beyond_the_cut_nothing_is_seen() -> None:
    assert seen(replace(tomato(0.0), shape=Sphere([0.64, 0.0, 1.0], 0.03))).in_image[0] == 0.0
    assert seen(replace(tomato(0.0), shape=Sphere([0.61, 0.0, 1.0], 0.03))).in_image[0] > 0.5


def test_the_edge_of_the_image_counts_for_the_whole_alone() -> None:
    edge = 0.5 * (K.width / 2) / K.fx
    half = seen(tomato(-edge))
    assert half.in_image[0] > 0.95
    assert half.whole[0] == pytest.approx(0.5, abs=0.06)
    assert seen(tomato(-edge - 0.1)).in_image[0] == 0.0


def test_where_a_stereo_camera_measures_no_depth_only_color_shows_anything() -> None:
    first_measured = 0.5 * (K.width / 2) / K.fx - StereoNoise().baseline
    half = seen(tomato(first_measured))
    assert half.in_image[0] == pytest.approx(0.45, abs=0.08)  # the front of the ball is hidden farther than its middle
    assert half.in_color[0] > 0.97
    hidden = seen(tomato(first_measured), wall(first_measured, 0.3))
    assert hidden.in_color[0] == 0.0


def test_the_best_frame_counts() -> None:
    row = row_of(tomato(0.0), wall(-0.2, 0.2))
    there = np.stack([np.eye(4), pose(translation=[0.0, 0.2, 0.0])])
    both = visibility(row, row.tomatoes, np.array([0]), ONE_CAMERA, there)
    assert both.in_image[0] > 0.97


def test_pieces_make_up_the_whole() -> None:
    stem = Stem([0, 0, 0], [0, 0, 0.05], 0.002, "peduncle")
    leaf = Box([1, 2, 3], [0.03, 0.015, 0.001], rotation_about([1, 1, 0], 0.4))
    pieces, owner = cut([stem, Sphere([0, 0, 0], 0.03), leaf], max_length=0.02)
    np.testing.assert_array_equal(owner, [0, 0, 0, 1, 2, 2, 2, 2, 2, 2])
    assert [type(piece) for piece in pieces[:4]] == [Stem, Stem, Stem, Sphere]
    assert sum(p.length for p in pieces if isinstance(p, Stem)) == pytest.approx(0.05)
    np.testing.assert_allclose(pieces[2].end, stem.end)
    boxes = [piece for piece in pieces if isinstance(piece, Box)]
    assert sum(8 * np.prod(box.half_extents) for box in boxes) == pytest.approx(8 * np.prod(leaf.half_extents))
    inside = leaf.center + (np.random.default_rng(0).uniform(-1, 1, (200, 3)) * leaf.half_extents) @ leaf.rotation.T
    assert distance_to_shapes(inside, boxes).min(axis=1).max() < 1e-9


def test_only_the_visible_part_of_a_stem_counts() -> None:
    stem = Stem([0.5, -0.1, 1.0], [0.5, 0.1, 1.0], 0.004, "main")
    shown = visible_row(row_of(stem, wall(0.2, 0.2)), ONE_CAMERA, np.eye(4)[None])
    assert sum(piece.length for piece in shown.stems) == pytest.approx(0.1, abs=0.021)
    assert max(piece.end[1] for piece in shown.stems) <= 0.021
    assert len(shown.clutter) > 50  # the board itself


# -- tomatoes ---------------------------------------------------------------------------------------------------------


def fruits() -> list[Tomato]:
    """Two trusses of three and one of two: green, turning and ripe."""
    return [
        *(tomato(0.1 * k, truss=0, ripeness=0.1) for k in range(3)),
        *(tomato(0.1 * k, truss=1, ripeness=0.5, z=1.2) for k in range(3)),
        *(tomato(0.1 * k, truss=2, ripeness=0.9, z=1.4) for k in range(2)),
    ]


def known(shares: Array | None = None) -> Visibility:
    values = np.ones(8) if shares is None else shares
    return Visibility(values, values, values)


def compared(found: list[Tomato], shares: Array | None = None) -> TomatoComparison:
    return compare_tomatoes(fruits(), known(shares), found)


def renamed(found: list[Tomato]) -> list[Tomato]:
    """The same trusses under other numbers."""
    return [replace(t, truss=7 - t.truss) for t in found]


def test_perfect_tomatoes_give_perfect_figures() -> None:
    perfect = compared(renamed(fruits())[::-1])
    assert (perfect.precision, perfect.recall, perfect.f1) == (1.0, 1.0, 1.0)
    assert perfect.truss_right.tolist() == [True, True, True]
    np.testing.assert_allclose([perfect.center_error, perfect.diameter_error], 0.0)
    assert {n: len(perfect.of_ripeness(*b).found) for n, b in RIPENESS_BANDS.items()} == {
        "green": 3, "turning": 3, "ripe": 2,
    }  # fmt: skip
    assert len(perfect.of_visible_fraction(*OCCLUSION_BANDS["free"]).found) == 8


def test_one_missed_tomato_costs_recall_in_its_band_and_its_truss() -> None:
    found = compared(fruits()[1:])
    assert (found.precision, found.recall) == (1.0, 7 / 8)
    assert found.f1 == pytest.approx(14 / 15)
    assert found.truss_right.tolist() == [False, True, True]
    assert found.of_ripeness(*RIPENESS_BANDS["green"]).recall == 2 / 3
    assert found.of_ripeness(*RIPENESS_BANDS["ripe"]).f1 == 1.0


def test_one_false_tomato_costs_precision_in_the_band_it_claims() -> None:
    beside = tomato(0.5, truss=9, ripeness=0.95)
    found = compared([*fruits(), beside])
    assert (found.precision, found.recall) == (8 / 9, 1.0)
    assert found.of_ripeness(*RIPENESS_BANDS["ripe"]).precision == 2 / 3
    assert found.of_ripeness(*RIPENESS_BANDS["green"]).precision == 1.0
    assert found.truss_right.all()  # it hangs on a truss of its own
    assert compared([*fruits(), replace(beside, truss=1)]).truss_right.tolist() == [True, False, True]


def test_a_moved_tomato_is_off_within_a_radius_and_lost_beyond() -> None:
    first, *others = fruits()
    near = compared([replace(first, shape=Sphere(first.center + [0, 0, 0.02], 0.033)), *others])
    assert near.f1 == 1.0
    assert sorted(near.center_error)[-2:] == pytest.approx([0.0, 0.02])
    assert max(near.diameter_error) == pytest.approx(0.1)
    far = compared([replace(first, shape=Sphere(first.center - [0, 0, 0.031], first.radius)), *others])
    assert (far.precision, far.recall) == (7 / 8, 7 / 8)
    assert far.truss_right.tolist() == [False, True, True]


def test_a_false_tomato_takes_no_other_ones_partner() -> None:
    true = [tomato(0.0, truss=0), tomato(0.1, truss=0)]
    matches = match_tomatoes(true, [tomato(0.005, truss=0), tomato(-0.1, truss=0)])  # by distance, 0.1 to 0.005 as well
    assert (matches.true.tolist(), matches.found.tolist()) == ([0], [0])


def test_split_and_joined_trusses_are_wrong() -> None:
    split = [replace(t, truss=5) if i == 0 else t for i, t in enumerate(fruits())]
    assert compared(split).truss_right.tolist() == [False, True, True]
    joined = [replace(t, truss=1) if t.truss == 2 else t for t in fruits()]
    assert compared(joined).truss_right.tolist() == [True, False, False]


def test_hidden_tomatoes_count_for_neither_side() -> None:
    shares = np.array([0.1, 1.0, 0.5, 1, 1, 1, 1, 1])
    for found in (fruits(), fruits()[1:]):
        result = compared(found, shares)
        assert (len(result.found), result.f1) == (7, 1.0)
        assert result.truss_right.all()
    assert compared(fruits(), shares).of_visible_fraction(0.3, 0.6).visible_fraction.tolist() == [0.5]


def test_nothing_found_or_nothing_there() -> None:
    nothing = compared([])
    assert (nothing.recall, nothing.f1) == (0.0, 0.0)
    assert np.isnan(nothing.precision)
    assert nothing.truss_right.tolist() == [False, False, False]
    empty = compare_tomatoes([], Visibility(*np.zeros((3, 0))), fruits())
    assert (empty.precision, len(empty.false), len(empty.truss_right)) == (0.0, 8, 0)
    both = pool_tomatoes([nothing, compared(fruits())])
    assert both.recall == 0.5
    assert both.truss_right.mean() == 0.5


# -- stems ------------------------------------------------------------------------------------------------------------


def upright(y: float, low: float, high: float, kind: StemKind = "main", radius: float = 0.005) -> Stem:
    return Stem([0.5, y, low], [0.5, y, high], radius, kind)


def stems(found: list[Stem], kind: str = "main", others: list[Capsule] | None = None) -> StemComparison:
    true = [upright(0.0, 0.0, 1.0), upright(1.0, 0.0, 1.0), Stem([0.5, 0, 0.5], [0.4, 0, 0.5], 0.002, "peduncle")]
    return compare_stems(true, true, others or [], found, kind)


def test_perfect_stems_give_perfect_figures() -> None:
    found = [upright(0.0, 0.0, 1.0), upright(1.0, 0.0, 0.4), upright(1.0, 0.4, 1.0)]
    perfect = stems(found)
    assert (perfect.recall, perfect.recall_as_such, perfect.false_fraction) == pytest.approx((1.0, 1.0, 0.0))
    assert perfect.visible == pytest.approx(2.0)
    assert max(perfect.axis_error.max(), perfect.radius_error.max()) < 1e-9
    assert stems(found, "peduncle").recall == 0.0  # the stem it leaves runs across it
    assert np.isnan(stems(found, "pipe").recall)


def test_half_a_stem_is_half_of_its_length() -> None:
    assert stems([upright(0.0, 0.0, 0.5)]).recall == pytest.approx(0.25, abs=0.006)


def test_a_stem_beside_is_off_within_the_tolerance_and_false_beyond() -> None:
    off = stems([upright(0.006, 0.0, 1.0, radius=0.006)])
    assert off.recall == pytest.approx(0.5)
    assert np.median(off.axis_error) == pytest.approx(0.006)
    assert np.median(off.radius_error) == pytest.approx(0.2)
    lost = stems([upright(0.012, 0.0, 1.0)])
    assert (lost.recall, lost.false_fraction, len(lost.axis_error)) == (0.0, 1.0, 0)


def test_a_stem_across_is_false() -> None:
    across = stems([Stem([0.5, -0.1, 0.3], [0.5, 0.1, 0.3], 0.005, "main")])
    assert (across.recall, across.false_fraction) == (0.0, 1.0)
    slope = 0.01 * np.tan(np.deg2rad(20))
    slanting = Stem([0.5, -slope, 0.29], [0.5, slope, 0.31], 0.005, "main")
    assert stems([slanting]).false_fraction == 0.0


def test_another_kind_counts_for_recall_but_not_as_such() -> None:
    found = stems([upright(0.0, 0.0, 1.0, "string")])
    assert (found.recall, found.recall_as_such, found.extracted) == (0.5, 0.0, 0.0)
    assert stems([upright(0.0, 0.0, 1.0, "string")], "string").false_fraction == 0.0


def test_false_stems_on_petioles_are_told_apart() -> None:
    petiole = Capsule([0.5, 0.5, 0.5], [0.5, 0.5, 0.7], 0.0025)
    found = [upright(0.5, 0.5, 0.6, "peduncle"), upright(0.7, 0.5, 0.6, "peduncle")]
    result = stems(found, "peduncle", [petiole])
    assert result.false_fraction == 1.0
    assert result.on_petioles == pytest.approx(0.1)


def test_pooled_stems_add_up() -> None:
    both = pool_stems([stems([upright(0.0, 0.0, 1.0)]), stems([])])
    assert (both.recall, both.visible) == pytest.approx((0.25, 4.0))
    assert np.isnan(stems([]).false_fraction)


# -- coverage, excess, alignment --------------------------------------------------------------------------------------


def test_coverage_is_the_share_of_points_within_reach_of_a_shape() -> None:
    ball = Sphere([0, 0, 0], 0.03)
    at = np.array([0.0, 0.02, 0.0379, 0.0381])
    assert coverage(np.column_stack([at, 0 * at, 0 * at]), [ball]) == 0.75
    assert coverage(np.zeros((3, 3)), []) == 0.0


@pytest.mark.parametrize(
    "shape",
    [
        Sphere([1, 2, 3], 0.1),
        Capsule([1, 2, 3], [1.2, 2.1, 3], 0.05),
        Capsule([1, 2, 3], [1, 2, 3], 0.05),
        Box([1, 2, 3], [0.1, 0.02, 0.3], rotation_about([1, 2, 3], 0.7)),
    ],
)
def test_samples_lie_evenly_on_a_surface(shape: Shape) -> None:
    points = outer_samples([shape], 40_000, np.random.default_rng(0))
    assert len(points) == 40_000
    assert np.abs(distance_to_shapes(points, [shape])).max() < 1e-9
    middle = (shape.start + shape.end) / 2 if isinstance(shape, Capsule) else shape.center
    assert np.linalg.norm(points.mean(axis=0) - middle) < 0.005
    if isinstance(shape, Capsule) and shape.length:
        along = (points - shape.start) @ (shape.end - shape.start) / shape.length**2
        on_ends = (along < 0) | (along > 1)
        caps, side = 4 * np.pi * 0.05**2, 2 * np.pi * 0.05 * shape.length
        assert on_ends.mean() == pytest.approx(caps / (caps + side), abs=0.01)


def test_surface_inside_another_shape_does_not_count() -> None:
    big, small = Sphere([0, 0, 0], 0.1), Sphere([0.05, 0, 0], 0.01)
    inner = outer_samples([big, small], 5000, np.random.default_rng(0))
    assert np.abs(np.linalg.norm(inner, axis=1) - 0.1).max() < 1e-9


def test_true_shapes_have_no_excess_and_bloated_ones_do() -> None:
    row = row_of(tomato(0.0), Stem([0.5, 0.2, 0.8], [0.5, 0.2, 1.4], 0.006, "main"), wall(0.6, 0.1))
    true = row.shapes
    assert excess(true, row) == 0.0
    assert excess([Sphere([0.5, 0.0, 1.0], 0.01)], row) == 0.0  # inside of what is there
    assert excess([Sphere([0.5, 0.0, 1.0], 0.044)], row) == 0.0
    assert excess([Sphere([0.5, 0.0, 1.0], 0.047)], row) == 1.0
    away = transformed(row.stems[0], pose(translation=[0, -0.1, 0]))
    share = 2 * np.pi * 0.006 * 0.6 + 4 * np.pi * 0.006**2
    ball = 4 * np.pi * 0.03**2
    assert excess([row.tomatoes[0].shape, away], row) == pytest.approx(share / (share + ball), abs=0.03)
    assert excess([], row) == 0.0


def test_a_moved_shape_has_moved() -> None:
    there = pose(rotation_about([0, 0, 1], np.pi / 2), [1.0, 0.0, 0.0])
    ball = Tomato(Sphere([1, 0, 0], 0.03), truss=3, ripeness=0.5).transformed(there)
    np.testing.assert_allclose(ball.center, [1, 1, 0], atol=1e-12)
    assert (ball.truss, ball.ripeness, ball.radius) == (3, 0.5, 0.03)
    stem = transformed(Stem([0, 0, 0], [1, 0, 0], 0.01, "string"), there)
    np.testing.assert_allclose([stem.start, stem.end], [[1, 0, 0], [1, 1, 0]], atol=1e-12)
    assert stem.kind == "string"
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    box = Box([0.1, 0.2, 0.3], [0.3, 0.2, 0.1], rotation_about([1, 0, 0], 0.3))
    after = points @ there[:3, :3].T + there[:3, 3]
    np.testing.assert_allclose(distance_to_shapes(after, [transformed(box, there)]), distance_to_shapes(points, [box]))


@cache
def grown() -> tuple[PlantRow, Array]:
    return grow_row(seed=3, length=0.5), tripod_poses(3, 3, HALF, CaptureSettings())


def test_alignment_finds_a_rigid_motion() -> None:
    row, stations = grown()
    surface = visible_surface(row, HALF, stations)

    class Known:
        points = surface
        registered = np.ones(3, dtype=bool)
        world_from_station = np.linalg.inv(stations[0]) @ stations

    off = pose(rotation_about([0, 0, 1], 0.004), [0.003, -0.004, 0.005])
    found = align(Known, row, np.array([off]))
    np.testing.assert_allclose(found, np.eye(4), atol=3e-4)
