from __future__ import annotations

import itertools

import numpy as np
import pytest

from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.geometry import Array, distance_to_shapes, frame_along
from greenhouse_gym.shapes import ShapeSettings, extract_shapes
from greenhouse_gym.shapes.neighborhoods import estimate_normals
from greenhouse_gym.shapes.stems.main_stems import STRING_RADIUS, find_main_stems

SETTINGS = ShapeSettings()
GREEN = [0.36, 0.50, 0.22]


def rod(
    start: list[float], end: list[float], radius: float, turn: float = np.pi, noise: float = 0.0007, seed: int = 0
) -> tuple[Array, Array]:
    """Points, about 2 mm apart, and normals of a rod's side, up to an angle from where it faces the camera."""
    random = np.random.default_rng(seed)
    a, b = np.array(start), np.array(end)
    frame = frame_along(b - a)
    count = int(2 * turn * radius * np.linalg.norm(b - a) / 0.002**2)
    ahead = np.arctan2(*(frame.T @ [-1.0, 0.0, 0.0])[[1, 0]])
    angle = ahead + random.uniform(-turn, turn, count)
    normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)]) @ frame.T
    points = a + random.uniform(0, 1, (count, 1)) * (b - a)
    return points + (radius + random.normal(0, noise, (count, 1))) * normals, normals


def test_a_pale_string_next_to_a_stem_is_separated_from_it() -> None:
    stem, string = ([0.5, 0.2, 0.6], [0.5, 0.2, 1.4]), ([0.5, 0.212, 0.6], [0.5, 0.212, 1.4])
    (green, out), (pale, away) = rod(*stem, 0.006, np.pi / 2), rod(*string, 0.0015, np.pi / 2)
    points, normals = np.concatenate([green, pale]), np.concatenate([out, away])
    colors = np.repeat([GREEN, [0.6, 0.6, 0.56]], [len(green), len(pale)], axis=0)
    found = extract_shapes(points, colors, normals).stems
    for kind, ends in (("main", stem), ("string", string)):
        own = [s for s in found if s.kind == kind]
        assert off_axis(own, *ends).max() < 0.003
        assert max(distance_to_shapes(np.array([s.start, s.end]), [Stem(*ends, 0.004, "main")]).max() for s in own) < 0
    assert {s.radius for s in found if s.kind == "string"} == {STRING_RADIUS}
    one_color = extract_shapes(points, np.tile(GREEN, (len(points), 1)), normals).stems
    assert not any(s.kind == "string" for s in one_color)


def off_axis(stems: list[Stem], start: list[float], end: list[float]) -> Array:
    """Distances of points along a line, except for 5 cm at its ends, from the axes of stems."""
    length = float(np.linalg.norm(np.subtract(end, start)))
    fraction = np.linspace(0.05 / length, 1 - 0.05 / length, 50)[:, None]
    points = np.array(start) + fraction * np.subtract(end, start)
    return distance_to_shapes(points, [Stem(s.start, s.end, 1e-9, "main") for s in stems]).min(axis=1)


ENDS = {
    "upright": ([0.5, 0.2, 0.6], [0.5, 0.2, 1.2]),
    "leaning sideways": ([0.5, 0.0, 0.6], [0.5, 0.4, 1.2]),
    "leaning away": ([0.4, 0.0, 0.6], [0.8, 0.1, 1.2]),
    "half lying": ([0.5, 0.0, 0.6], [0.5, 0.5, 1.15]),
}


@pytest.mark.parametrize("turn", [np.pi / 2, np.pi], ids=["one side seen", "all around"])
@pytest.mark.parametrize("pose", ENDS)
def test_slanted_stems_are_followed(pose: str, turn: float) -> None:
    points, normals = rod(*ENDS[pose], 0.006, turn)
    stems = find_main_stems(points, normals, SETTINGS)
    assert off_axis(stems, *ENDS[pose]).max() < 0.003
    assert (
        max(distance_to_shapes(np.array([s.start, s.end]), [Stem(*ENDS[pose], 0.006, "main")]).max() for s in stems) < 0
    )
    assert all(stem.radius == pytest.approx(0.006, abs=0.0012) for stem in stems)


@pytest.mark.parametrize("pose", ["upright", "leaning sideways"])
def test_a_scanned_stem_is_followed_without_normals(pose: str) -> None:
    points, _ = rod(*ENDS[pose], 0.006, noise=0.001)
    shapes = extract_shapes(points, np.tile(GREEN, (len(points), 1)))
    assert {stem.kind for stem in shapes.stems} == {"main"}
    assert shapes.tomatoes == ()
    assert off_axis(list(shapes.stems), *ENDS[pose]).max() < 0.003
    assert all(stem.radius == pytest.approx(0.006, abs=0.002) for stem in shapes.stems)


def test_a_bent_stem_is_followed_behind_an_occluder() -> None:
    height = np.linspace(0.6, 1.2, 61)
    line = np.column_stack([np.full(61, 0.5), 0.12 * np.sin(5 * (height - 0.6)), height])
    parts = [rod(list(a), list(b), 0.006, seed=k) for k, (a, b) in enumerate(itertools.pairwise(line))]
    points, normals = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    shown = np.abs(points[:, 2] - 0.9) > 0.04
    stems = find_main_stems(points[shown], normals[shown], SETTINGS)
    off = distance_to_shapes(line[2:-2], [Stem(s.start, s.end, 1e-9, "main") for s in stems]).min(axis=1)
    assert np.median(off) < 0.003
    assert off.max() < 0.010


@pytest.mark.parametrize("radius", [0.005, 0.008])
def test_normals_point_out_of_a_rod_seen_from_all_sides(radius: float) -> None:
    points, true = rod([0.5, 0.2, 0.6], [0.5, 0.5, 1.2], radius, noise=0.0003)
    thinned = points[::2]
    normals = estimate_normals(thinned)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    aligned = (normals * true[::2]).sum(axis=1)
    assert (aligned > 0.5).mean() > 0.95
    assert np.median(aligned) > 0.9


def test_normals_of_a_wall_point_to_the_camera() -> None:
    random = np.random.default_rng(0)
    points = random.uniform(-0.1, 0.1, (5000, 3)) * [0.002, 1.0, 1.0]
    assert (estimate_normals(points)[:, 0] < -0.9).mean() > 0.95


@pytest.mark.parametrize("count", [0, 1, 2, 3, 40])
def test_normals_of_few_or_degenerate_points(count: int) -> None:
    for points in (np.zeros((count, 3)), np.arange(3.0 * count).reshape(-1, 3) / 1000):  # one point, one line
        assert np.isfinite(estimate_normals(points)).all()
