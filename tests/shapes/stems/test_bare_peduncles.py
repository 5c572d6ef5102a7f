"""Peduncles without detected fruit: traced along lines of probable points only."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.geometry import distance_to_shapes
from greenhouse_gym.shapes import ShapeSettings
from greenhouse_gym.shapes.stems.traced_peduncles import MIN_LENGTH, find_bare_peduncles

SETTINGS = ShapeSettings()


def arc(count: int = 40, radius: float = 0.08) -> np.ndarray:
    """Points along a bent peduncle of 13 cm, a few millimetres apart."""
    angle = np.linspace(0.0, 1.6, count)
    return np.column_stack([0.6 + radius * np.sin(angle), 0.2 + 0.02 * angle, 1.0 + radius * np.cos(angle)])


def scattered(line: np.ndarray, seed: int = 0) -> np.ndarray:
    """The same points shuffled, with noise of 0.5 mm."""
    rng = np.random.default_rng(seed)
    return rng.permutation(line + rng.normal(0.0, 0.0005, line.shape))


@pytest.mark.parametrize("seed", range(3))
def test_a_bent_peduncle_is_traced_from_end_to_end(seed: int) -> None:
    stems = find_bare_peduncles(scattered(arc(), seed), [], SETTINGS.axis_tolerance)
    assert {stem.kind for stem in stems} == {"peduncle"}
    assert 1 < len(stems) < 8
    off = distance_to_shapes(arc(), stems).min(axis=1)
    assert off.max() < SETTINGS.axis_tolerance
    length = np.linalg.norm(np.diff(arc(), axis=0), axis=1).sum()
    assert sum(stem.length for stem in stems) == pytest.approx(length, rel=0.06)


def test_two_peduncles_become_two_chains_in_any_order() -> None:
    both = np.concatenate([arc(), arc() + [0.0, 0.03, 0.0]])
    stems = find_bare_peduncles(scattered(both), [], SETTINGS.axis_tolerance)
    again = find_bare_peduncles(scattered(both)[::-1], [], SETTINGS.axis_tolerance)
    for line in (arc(), arc() + [0.0, 0.03, 0.0]):
        for found in (stems, again):
            assert distance_to_shapes(line, found).min(axis=1).max() < SETTINGS.axis_tolerance
    length = 2 * np.linalg.norm(np.diff(arc(), axis=0), axis=1).sum()
    assert sum(stem.length for stem in stems) == pytest.approx(length, rel=0.06), "nothing bridges the two"


def test_points_of_other_stems_are_not_traced_again() -> None:
    chain = find_bare_peduncles(scattered(arc()), [], SETTINGS.axis_tolerance)
    assert find_bare_peduncles(scattered(arc(), 1), chain, SETTINGS.axis_tolerance) == []
    half = [Stem(arc()[k], arc()[k + 1], 0.002, kind="peduncle") for k in range(20)]
    rest = find_bare_peduncles(scattered(arc()), half, SETTINGS.axis_tolerance)
    assert distance_to_shapes(arc()[28:], rest).min(axis=1).max() < SETTINGS.axis_tolerance
    assert distance_to_shapes(arc()[:18], rest).min() > 0.0


def test_single_points_short_pieces_and_scattered_points_are_no_peduncles() -> None:
    short = arc()[: int(40 * 0.8 * MIN_LENGTH / 0.13)]
    assert find_bare_peduncles(short, [], SETTINGS.axis_tolerance) == []
    random = np.random.default_rng(0).uniform(0.0, 1.0, (300, 3))
    assert find_bare_peduncles(random, [], SETTINGS.axis_tolerance) == []
    for nodes in (np.zeros((0, 3)), np.zeros((1, 3)), np.zeros((5, 3))):
        assert find_bare_peduncles(nodes, [], SETTINGS.axis_tolerance) == []
