"""Candidate points of peduncles whose stems are redder than leaves, greener, or of the same color."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Sphere, frame_along
from greenhouse_gym.geometry.point_clouds import Cloud, merge, voxel_means
from greenhouse_gym.shapes import ShapeSettings
from greenhouse_gym.shapes.evidence import off_skin_mask
from greenhouse_gym.shapes.networks import network, network_file
from greenhouse_gym.shapes.stems.peduncle_features import (
    COLOR_FEATURES,
    FEATURES,
    STEM_MARGIN,
    TRUSS_REACH,
    peduncle_candidates,
)
from greenhouse_gym.shapes.surface_cloud import measure_surface

SETTINGS = ShapeSettings()
LEAF, RED = np.array([0.40, 0.50, 0.26]), np.array([0.76, 0.10, 0.07])
FRUITS = (Tomato(Sphere([0.42, 0.16, 1.0], 0.025), 0), Tomato(Sphere([0.42, 0.24, 1.0], 0.025), 0))
MAIN = [Stem([0.5, 0.2, 0.6], [0.5, 0.2, 1.4], 0.006, "main")]
FORK = (0.42, 0.2, 1.03)


def tube(start: tuple[float, ...], end: tuple[float, ...], radius: float, color: np.ndarray, seed: int = 0) -> Cloud:
    """The side of a tube that faces the aisle, a point per 1.5 mm square, with a third of a millimetre of noise."""
    random = np.random.default_rng(seed)
    axis = np.subtract(end, start)
    length = float(np.linalg.norm(axis))
    count = int(2 * np.pi * radius * length / 0.0015**2)
    frame, angle = frame_along(axis), random.uniform(0, 2 * np.pi, count)
    normals = np.cos(angle)[:, None] * frame[:, 0] + np.sin(angle)[:, None] * frame[:, 1]
    points = start + random.uniform(0, 1, (count, 1)) * axis + (radius + random.normal(0, 0.0003, (count, 1))) * normals
    near = normals[:, 0] < 0.2
    return Cloud(points[near], np.tile(color, (near.sum(), 1)), normals[near])


def sheet(color: np.ndarray, x: float = 0.53) -> Cloud:
    """A leaf of 30 by 30 cm behind everything."""
    y, z = np.random.default_rng(5).uniform(-0.15, 0.15, (2, 22_500))
    points = np.column_stack([np.full(len(y), x), 0.2 + y, 1.0 + z])
    return Cloud(points, np.tile(color, (len(y), 1)), np.tile([-1.0, 0.0, 0.0], (len(y), 1)))


def truss(stem: np.ndarray, leaf: np.ndarray) -> Cloud:
    """A main stem, a peduncle that leaves it, a pedicel to each fruit, and a leaf behind."""
    parts = [tube((0.5, 0.2, 0.6), (0.5, 0.2, 1.4), 0.006, stem), tube((0.494, 0.2, 1.06), FORK, 0.002, stem, 1)]
    for fruit in FRUITS:
        axis = np.array(FORK) - fruit.center
        parts.append(tube(FORK, tuple(fruit.center + 0.025 * axis / np.linalg.norm(axis)), 0.0014, stem, 2))
    return voxel_means(merge([*parts, sheet(leaf)]), SETTINGS.voxel)[0]


@pytest.mark.parametrize("shift", [-0.06, 0.0, 0.06])
def test_peduncles_are_probable_whatever_their_color(shift: float) -> None:
    surface = measure_surface(truss(np.clip(LEAF + [shift, 0.0, 0.0], 0, 1), LEAF))
    candidates = peduncle_candidates(surface, FRUITS, MAIN)
    likely = network("stems/peduncles")(candidates.features) > 0.2
    on_sheet = candidates.nodes[:, 0] > 0.52
    assert on_sheet.sum() > 500
    assert (~on_sheet).sum() > 20
    assert likely[~on_sheet].mean() > 0.7
    assert likely[on_sheet].mean() < 0.02


def test_skin_and_main_stems_are_no_candidates() -> None:
    cloud = truss(LEAF, LEAF)
    candidates = peduncle_candidates(measure_surface(cloud), FRUITS, MAIN)
    away = np.linalg.norm(candidates.nodes[:, None] - [f.center for f in FRUITS], axis=-1).min(axis=1)
    assert away.max() < TRUSS_REACH + 0.01
    assert (np.hypot(candidates.nodes[:, 0] - 0.5, candidates.nodes[:, 1] - 0.2) > STEM_MARGIN).all()


def test_features_do_not_depend_on_absolute_colors() -> None:
    """White balance and exposure change all colors of a row alike; a gray row has none at all."""
    features = []
    for stem, leaf in ((LEAF, LEAF), (0.7 * LEAF, 0.7 * LEAF), (np.full(3, 0.5), np.full(3, 0.5))):
        surface = measure_surface(truss(stem, leaf))
        features.append(peduncle_candidates(surface, FRUITS, MAIN).features)
    np.testing.assert_allclose(features[0], features[1], atol=1e-6)
    assert np.abs(features[2][:, list(COLOR_FEATURES)]).max() < 1e-6


@given(st.integers(0, 2**32), st.integers(0, 60), st.integers(0, 3))
def test_features_are_finite_for_any_cloud(seed: int, count: int, fruits: int) -> None:
    random = np.random.default_rng(seed)
    points = np.array([0.42, 0.2, 1.0]) + random.normal(0, 0.03, (count, 3))
    cloud = Cloud(points, random.uniform(0, 1, (count, 3)), random.normal(0, 1, (count, 3)))
    surface = measure_surface(voxel_means(cloud, SETTINGS.voxel)[0] if count else cloud)
    hung = (*FRUITS, Tomato(Sphere([0.40, 0.2, 0.97], 0.02), 1))[:fruits]
    candidates = peduncle_candidates(surface, hung, MAIN[: seed % 2])
    assert candidates.features.shape == (len(candidates.nodes), len(FEATURES))
    assert np.isfinite(candidates.features).all()
    likely = network("stems/peduncles")(candidates.features)
    assert ((likely >= 0) & (likely <= 1)).all()


def test_a_stem_in_front_of_the_skin_is_off_the_skin() -> None:
    ball = Tomato(Sphere([0.5, 0.0, 1.0], 0.03), 0)
    outwards = np.random.default_rng(0).normal(size=(400, 3))
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    assert not off_skin_mask(ball.center + 0.03 * outwards, outwards, (ball,)).any()
    t = np.linspace(-0.02, 0.02, 30)
    stem = np.column_stack([np.full(30, 0.5 - 0.033), t, np.full(30, 1.0)])  # its upper edge
    assert off_skin_mask(stem, np.tile([0.0, 0.0, 1.0], (30, 1)), (ball,)).all()
    assert off_skin_mask(stem, np.tile([0.0, 0.0, 1.0], (30, 1)), ()).all()


def test_the_network_takes_all_features() -> None:
    assert network_file("stems/peduncles").is_file()
    assert len(network("stems/peduncles").center) == len(FEATURES)
