from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.geometry import Array, frame_along
from greenhouse_gym.geometry.point_clouds import Cloud, voxel_means
from greenhouse_gym.shapes import ShapeSettings, extract_shapes
from greenhouse_gym.shapes.stems.pipes import find_pipes

SETTINGS = ShapeSettings()
GRAY, LEAF, RED = [0.7, 0.7, 0.72], [0.20, 0.42, 0.16], [0.76, 0.10, 0.07]
VIEW = np.array([-1.0, 0.0, 0.0])
"""Towards the camera."""


def seen(points: Array, normals: Array, seed: int, color: list[float] = GRAY, noise: float = 0.001) -> Cloud:
    """The noisy side of a surface that faces a distant camera, without grazing angles."""
    random = np.random.default_rng(seed)
    facing = normals @ VIEW > 0.2
    points, normals = points[facing], normals[facing]
    points = points + random.normal(0, noise, (len(points), 1)) * normals
    normals = normals + random.normal(0, 0.1, normals.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Cloud(points, np.tile(color, (len(points), 1)), normals)


def tube(
    start: list[float], end: list[float], radius: float, seed: int = 0, turn: float = np.pi
) -> tuple[Array, Array]:
    """Points, 2 mm apart, and normals of a cylinder's side, up to an angle from where it faces the camera."""
    random = np.random.default_rng(seed)
    a, b = np.array(start), np.array(end)
    frame = frame_along(b - a)
    count = int(2 * turn * radius * np.linalg.norm(b - a) / 0.002**2)
    ahead = np.arctan2(*(frame.T @ VIEW)[[1, 0]])
    angle = ahead + random.uniform(-turn, turn, count)
    normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)]) @ frame.T
    return a + random.uniform(0, 1, (count, 1)) * (b - a) + radius * normals, normals


def ball(center: list[float], radius: float, seed: int = 0) -> tuple[Array, Array]:
    random = np.random.default_rng(seed)
    unit = random.normal(size=(int(4 * np.pi * radius**2 / 0.002**2), 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return center + radius * unit, unit


def merged(*clouds: Cloud) -> Cloud:
    return Cloud(*(np.concatenate([getattr(c, name) for c in clouds]) for name in ("points", "colors", "normals")))


def pipes_in(cloud: Cloud) -> list:
    return find_pipes(voxel_means(cloud, SETTINGS.voxel)[0], SETTINGS.pipe_radii)


def angle_between(one: Array, other: Array) -> float:
    return float(np.arccos(min(1.0, abs(one @ other) / np.linalg.norm(one) / np.linalg.norm(other))))


STANDING, LYING, SLANTED = [0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.3, 0.5, 0.8]


@pytest.mark.parametrize("along", [STANDING, LYING, SLANTED])
@pytest.mark.parametrize(("radius", "length"), [(0.033, 0.11), (0.0255, 0.6), (0.016, 0.2), (0.045, 0.2), (0.055, 0.6)])
def test_a_half_seen_cylinder_is_one_pipe(along: list[float], radius: float, length: float) -> None:
    start = np.array([0.5, 0.2, 1.0])
    end = start + length * np.array(along) / np.linalg.norm(along)
    pipes = pipes_in(seen(*tube(list(start), list(end), radius), seed=1))
    assert [pipe.kind for pipe in pipes] == ["pipe"]
    assert pipes[0].radius == pytest.approx(radius, abs=0.001)
    assert angle_between(pipes[0].end - pipes[0].start, end - start) < 0.02
    ends = sorted([pipes[0].start, pipes[0].end], key=lambda p: float(p @ along))
    np.testing.assert_allclose(ends, [start, end], atol=0.012)


def test_a_pipe_along_a_row_behind_leaves_and_fruit() -> None:
    wall = seen(*tube([0.6, 0.0, 0.9], [0.6, 1.0, 0.9], 0.0255), seed=1)
    shown = np.abs((wall.points[:, 1] * 5) % 1 - 0.5) > 0.1  # a leaf hides 4 cm of every 20
    random = np.random.default_rng(0)
    leaves = [
        Cloud(
            np.array([0.5, y, 0.9]) + random.uniform(-0.03, 0.03, (2000, 3)) * [0.0, 0.6, 1.0],
            np.tile(LEAF, (2000, 1)),
            np.tile(VIEW, (2000, 1)),
        )
        for y in (0.1, 0.3, 0.5, 0.7, 0.9)
    ]
    fruit = seen(*ball([0.5, 0.4, 1.05], 0.03), seed=2, color=RED)
    cloud = merged(wall.select(shown), *leaves, fruit)
    shapes = extract_shapes(cloud.points, cloud.colors, cloud.normals)
    pipes = [stem for stem in shapes.stems if stem.kind == "pipe"]
    assert len(shapes.tomatoes) == 1
    assert len(pipes) == 1
    assert pipes[0].radius == pytest.approx(0.0255, abs=0.001)
    assert abs(pipes[0].length - 1.0) < 0.03
    owners = np.bincount(shapes.evidence.owner[: shown.sum()] + 1, minlength=len(shapes.shapes) + 1)
    assert owners[1 + shapes.shapes.index(pipes[0])] > 0.99 * shown.sum()


def test_a_bent_pipe_is_a_chain() -> None:
    parts = ([0.5, 0.0, 1.0], [0.5, 0.4, 1.0]), ([0.5, 0.4, 1.0], [0.5, 0.4, 1.4])
    pipes = pipes_in(merged(*(seen(*tube(*part, 0.025), seed=1) for part in parts)))
    assert len(pipes) == 2
    for start, end in parts:
        away = np.array(end) - start
        assert min(angle_between(pipe.end - pipe.start, away) for pipe in pipes) < 0.03


def test_pipes_side_by_side_are_separated() -> None:
    clouds = [seen(*tube([0.5, 0.0, z], [0.5, 0.5, z], 0.0255, seed=k), seed=k) for k, z in enumerate((1.0, 1.052))]
    pipes = pipes_in(merged(*clouds))
    assert sorted(round(float(pipe.start[2]), 2) for pipe in pipes) == [1.0, 1.05]


@pytest.mark.parametrize("radius", [0.02, 0.03, 0.05])
@pytest.mark.parametrize("seed", range(2))
def test_fruit_is_no_pipe(radius: float, seed: int) -> None:
    stacked = [seen(*ball([0.5, 0.2, 1.0 + 2 * k * radius], radius, seed), seed, RED) for k in range(4)]
    assert pipes_in(stacked[0]) == []
    assert pipes_in(merged(*stacked)) == []
    shapes = extract_shapes(merged(*stacked).points, merged(*stacked).colors, merged(*stacked).normals)
    assert len(shapes.tomatoes) == 4


@pytest.mark.parametrize("radius", [0.02, 0.035, 0.05])
def test_a_leaf_bent_round_is_no_pipe(radius: float) -> None:
    points, normals = tube([0.5, 0.2, 1.0], [0.5, 0.2, 1.12], radius, turn=np.deg2rad(45))
    assert pipes_in(seen(points, normals, 0)) == []
    shapes = extract_shapes(*(vars(seen(points, normals, 0, LEAF))[k] for k in ("points", "colors", "normals")))
    assert shapes.stems == ()


def test_a_curl_in_the_color_of_leaves_is_no_pipe() -> None:
    curl = seen(*tube([0.5, 0.2, 1.0], [0.5, 0.2, 1.12], 0.03), 0, LEAF)
    assert len(pipes_in(curl)) == 1
    random = np.random.default_rng(0)
    flat = random.uniform([0.7, 0.0, 0.9], [0.7, 0.3, 1.2], (15_000, 3))  # gives the leaves' hue
    points, normals = np.concatenate([curl.points, flat]), np.vstack([curl.normals, np.tile([-1.0, 0, 0], (15_000, 1))])
    colors = np.vstack([curl.colors, np.tile(LEAF, (15_000, 1))])
    assert not any(stem.kind == "pipe" for stem in extract_shapes(points, colors, normals).stems)


@pytest.mark.parametrize("blur", [0.0, 0.01])
def test_the_edge_of_a_box_is_no_pipe(blur: float) -> None:
    """Two faces that meet in a right angle towards the camera, their normals blurred near the edge as sensors do."""
    random = np.random.default_rng(0)
    s = random.uniform(-0.08, 0.08, 16_000)
    side = np.sign(s)
    points = np.column_stack([0.5 + np.abs(s) / np.sqrt(2), s / np.sqrt(2), random.uniform(1.0, 1.3, len(s))])
    turn = np.pi / 4 * (np.clip(s / blur, -1, 1) if blur else side)
    normals = np.column_stack([-np.cos(turn), np.sin(turn), np.zeros(len(s))])
    assert pipes_in(seen(points, normals, 0)) == []


@pytest.mark.parametrize("radius", [0.004, 0.007, 0.010])
def test_a_plants_stem_is_no_pipe(radius: float) -> None:
    assert pipes_in(seen(*tube([0.5, 0.2, 0.6], [0.5, 0.2, 1.4], radius), 0)) == []


def test_a_tin_wider_than_high_and_a_drum_are_no_pipes() -> None:
    assert pipes_in(seen(*tube([0.5, 0.2, 1.0], [0.5, 0.2, 1.06], 0.05), 0)) == []
    assert pipes_in(seen(*tube([0.5, 0.2, 1.0], [0.5, 0.2, 1.5], 0.10), 0)) == []


@pytest.mark.parametrize("count", [0, 1, 2, 500])
def test_random_points_contain_no_pipe(count: int) -> None:
    random = np.random.default_rng(count)
    normals = random.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = Cloud(random.uniform(0, 0.2, (count, 3)), np.full((count, 3), 0.5), normals)
    assert find_pipes(cloud, SETTINGS.pipe_radii) == []
    assert find_pipes(Cloud(np.full((count, 3), 0.5), cloud.colors, normals), SETTINGS.pipe_radii) == []
