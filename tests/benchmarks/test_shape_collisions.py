from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.accuracy import Visibility, VisibleRow
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Box, Sphere

FRUITS = tuple(Sphere([0.3, y, 1.2], 0.08) for y in (-0.3, 0.0, 0.3))
STEM = Stem([0.5, 0.0, 0.5], [0.5, 0.0, 1.6], 0.03, "main")
LEAF = Box([0.3, 0.1, 1.5], [0.1, 0.1, 0.01], np.eye(3))
TRUTH = PlantRow(tuple(Tomato(fruit, truss=0) for fruit in FRUITS), (STEM,), (LEAF,), 1.0, 0)
POINTS = np.array([[0.4, y, z] for y in np.linspace(-0.5, 0.5, 11) for z in np.linspace(0.7, 1.5, 9)])


@pytest.fixture
def compare(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Count disagreements over some configurations, one stand."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))
    from benchmarks.sensing.shape_collisions import compare_collisions

    def run(shapes: list[Any], hidden: tuple[int, ...] = ()) -> Any:
        shares = np.array([0.0 if i in hidden else 1.0 for i in range(3)])
        visible = VisibleRow(Visibility(shares, shares, shares), (STEM,), (LEAF,))
        plain = [shape.shape if isinstance(shape, Tomato) else shape for shape in shapes]
        return compare_collisions(plain, TRUTH, visible, POINTS, [0.0], 300)

    return run


def test_true_shapes_agree_with_the_truth(compare: Callable[..., Any]) -> None:
    same = compare([*FRUITS, STEM, LEAF])
    assert same.configurations == 300
    assert same.free_in_shapes == same.free_in_truth > 50
    assert same.missed == same.invented == 0


def test_what_is_missing_is_missed_unless_nobody_could_see_it(compare: Callable[..., Any]) -> None:
    without = [*FRUITS[1:], STEM, LEAF]
    assert compare(without).missed > 0
    assert compare(without).invented == 0
    assert compare(without, hidden=(0,)).missed == 0
    assert compare([]).missed > compare(without).missed


def test_what_is_added_is_invented(compare: Callable[..., Any]) -> None:
    added = compare([*FRUITS, STEM, LEAF, Sphere([0.2, 0.0, 1.0], 0.1)])
    assert added.missed == 0
    assert added.invented > 0
    hidden = compare([*FRUITS, STEM, LEAF], hidden=(0, 1, 2))
    assert hidden.invented == 0  # what is there is not invented, seen or not
