"""Grouping of fruits into trusses by the gaps between their skins."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from greenhouse_gym.geometry import Sphere
from greenhouse_gym.shapes import ShapeSettings
from greenhouse_gym.shapes.fruit.trusses import group_neighbors, group_trusses

SPREAD = ShapeSettings().truss_spread
RADIUS = 0.02


def hanging(middle: tuple[float, float], count: int = 6) -> list[Sphere]:
    """A truss: fruits in two touching columns, around a position along the row and a height (metres)."""
    along, height = middle
    return [
        Sphere([0.5, along + (k % 2 - 0.5) * 2 * RADIUS, height + 2 * RADIUS * (k // 2 - 1)], RADIUS)
        for k in range(count)
    ]


def together(numbers: np.ndarray) -> set[frozenset[int]]:
    """The sets of fruits with the same number."""
    return {frozenset(np.flatnonzero(numbers == number).tolist()) for number in np.unique(numbers)}


def test_a_fruit_between_two_trusses_does_not_join_them() -> None:
    fruits = [*hanging((0.0, 1.2)), *hanging((0.24, 1.2)), Sphere([0.5, 0.12, 1.2], RADIUS)]
    assert len(together(group_neighbors(fruits, 0.065))) == 1
    groups = together(group_trusses(fruits, SPREAD))
    assert len(groups) == 2
    assert any(set(range(6)) <= group for group in groups)
    assert any(set(range(6, 12)) <= group for group in groups)


def test_hidden_fruit_does_not_split_a_truss() -> None:
    fruits = [fruit for k, fruit in enumerate(hanging((0.0, 1.2), 8)) if k not in (4, 5)]
    assert len(together(group_neighbors(fruits, 0.035))) == 2
    assert together(group_trusses(fruits, SPREAD)) == {frozenset(range(6))}


def test_trusses_one_above_the_other_stay_apart() -> None:
    fruits = [*hanging((0.0, 1.2)), *hanging((0.0, 1.44)), *hanging((0.0, 0.96))]
    assert together(group_trusses(fruits, SPREAD)) == {frozenset(range(6 * k, 6 * k + 6)) for k in range(3)}


@pytest.mark.parametrize("count", [0, 1])
def test_one_fruit_or_none_needs_no_grouping(count: int) -> None:
    for group in (group_neighbors, group_trusses):
        np.testing.assert_array_equal(group([Sphere([0, 0, 0], 0.03)] * count, 0.015), np.zeros(count))


centers = st.lists(st.tuples(*[st.floats(-0.3, 0.3)] * 3), min_size=2, max_size=12)


@given(centers, st.integers(0, 2**31))
def test_groups_depend_on_neither_order_nor_position(centers: list[tuple[float, float, float]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    fruits = [
        Sphere(center, rng.uniform(0.005, 0.04))
        for center in np.array(centers) + rng.normal(0, 0.01, (len(centers), 3))
    ]
    order = rng.permutation(len(fruits))
    moved = [Sphere(fruits[k].center + [1.0, -2.0, 0.5], fruits[k].radius) for k in order]
    for group, reach in ((group_neighbors, 0.035), (group_trusses, SPREAD)):
        numbers = group(fruits, reach)
        renamed = {frozenset(int(order[k]) for k in group) for group in together(group(moved, reach))}
        assert together(numbers) == renamed
        firsts = [int(np.flatnonzero(numbers == number)[0]) for number in range(numbers.max() + 1)]
        assert firsts == sorted(firsts), "they are counted in order of appearance"


@given(centers)
def test_neighbors_share_a_group_and_others_do_not(centers: list[tuple[float, float, float]]) -> None:
    fruits = [Sphere(center, 0.01) for center in centers]
    numbers = group_neighbors(fruits, 0.05)
    away = np.linalg.norm(np.array(centers)[:, None] - np.array(centers)[None], axis=-1) - 0.02
    apart = numbers[:, None] != numbers[None]
    assert not (apart & (away < 0.05 - 1e-9)).any()
    for number in np.unique(numbers):
        own = numbers == number
        assert own.all() or own.sum() == 1 or (away[own][:, own] + np.eye(own.sum()) < 0.05 + 1e-9).any(axis=1).all()
