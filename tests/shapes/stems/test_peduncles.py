"""Peduncles and pedicels traced through probable points."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Sphere, distance_to_shapes
from greenhouse_gym.shapes import ShapeSettings
from greenhouse_gym.shapes.stems.peduncles import find_peduncles

SETTINGS = ShapeSettings()


def truss_of_two() -> tuple[tuple[Tomato, ...], list[Stem], np.ndarray]:
    """Two fruits left and right of a peduncle that leaves a main stem, and the peduncle's and pedicels' points."""
    fruits = (Tomato(Sphere([0.42, 0.16, 1.0], 0.025), 0), Tomato(Sphere([0.42, 0.24, 1.0], 0.025), 0))
    main = [Stem([0.5, 0.2, 0.6], [0.5, 0.2, 1.4], 0.006, "main")]
    paths = [([0.492, 0.2, 1.05], [0.42, 0.2, 1.03])]
    paths += [([0.42, 0.2, 1.03], f.center + 0.025 * (t := np.array([0.42, 0.2, 1.03]) - f.center) / np.linalg.norm(t))
             for f in fruits]  # fmt: skip
    line = [np.linspace(a, b, 60) for a, b in paths]
    return fruits, main, np.concatenate(line)


@pytest.mark.parametrize("hidden", [False, True])
def test_a_peduncle_forks_into_a_pedicel_for_each_fruit(hidden: bool) -> None:
    fruits, main, points = truss_of_two()
    if hidden:  # a leaf in front of a centimetre of the peduncle
        points = points[np.abs(points[:, 0] - 0.46) > 0.005]
    stems = find_peduncles(points, fruits, main, SETTINGS.axis_tolerance)
    assert {stem.kind for stem in stems} == {"peduncle", "pedicel"}
    assert distance_to_shapes(truss_of_two()[2], stems).min(axis=1).max() < 0.004
    for fruit in fruits:  # connected where the plant is connected
        assert min(abs(np.linalg.norm(s.end - fruit.center) - fruit.radius) for s in stems) < 1e-6
    assert min(distance_to_shapes(np.array([s.start for s in stems]), main).ravel()) < 0.0


def test_fruits_without_anything_near_hang_on_nothing() -> None:
    fruits, main, _ = truss_of_two()
    assert find_peduncles(np.zeros((0, 3)), fruits, main, SETTINGS.axis_tolerance) == []
    assert find_peduncles(np.array([[3.0, 3.0, 3.0]]), fruits, main, SETTINGS.axis_tolerance) == []
    assert find_peduncles(truss_of_two()[2], (), main, SETTINGS.axis_tolerance) == []


def test_a_truss_without_a_main_stem_is_traced() -> None:
    fruits, _, points = truss_of_two()
    stems = find_peduncles(points, fruits, [], SETTINGS.axis_tolerance)
    assert [stem.kind for stem in stems].count("pedicel") == 2
    assert sum(stem.length for stem in stems) > 0.04  # from fruit to fruit, since nothing shows where the rest leads


@pytest.mark.parametrize("count", [1, 2])
def test_only_several_fruits_make_a_bridge_over_a_wide_gap(count: int) -> None:
    fruits, main, points = truss_of_two()
    seen = points[np.abs(points[:, 0] - 0.46) > 0.015]  # three centimetres of the peduncle are hidden
    stems = find_peduncles(seen, fruits[:count], main, SETTINGS.axis_tolerance)
    hidden = points[np.abs(points[:, 0] - 0.46) < 0.01]
    assert (distance_to_shapes(hidden, stems).min(axis=1).max() < 0.004) == (count == 2)


def test_a_truss_hangs_from_above_its_middle() -> None:
    fruits, main, points = truss_of_two()
    below = np.linspace([0.492, 0.2, 0.94], [0.42, 0.2, 0.98], 60)  # a leaf's stalk, nearer to the stem's axis
    near = np.linspace([0.42, 0.2, 0.98], [0.42, 0.2, 1.03], 40)
    stems = find_peduncles(np.concatenate([points, below, near]), fruits, main, SETTINGS.axis_tolerance)
    at_stem = [s for s in stems if distance_to_shapes(s.start[None], main).min() < 0.0]
    assert len(at_stem) == 1
    assert at_stem[0].start[2] > 1.04
