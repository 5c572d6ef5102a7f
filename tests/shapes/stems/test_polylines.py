"""Simplified and fitted polylines."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.geometry import distance_to_shapes
from greenhouse_gym.shapes.robust_fit import fit_polyline, simplify_polyline


@pytest.mark.parametrize("tolerance", [0.001, 0.01])
def test_a_simplified_line_stays_near_the_line(tolerance: float) -> None:
    line = wave()
    rows = simplify_polyline(line, tolerance)
    assert 2 < len(rows) < 60
    assert (rows[0], rows[-1]) == (0, len(line) - 1)
    assert distances(line, line[rows]).max() <= tolerance


@pytest.mark.parametrize("tolerance", [0.001, 0.01])
def test_a_fitted_line_is_nearer_on_average(tolerance: float) -> None:
    line = wave()
    fit, own = fit_polyline(line, tolerance), line[simplify_polyline(line, tolerance)]
    assert len(fit) == len(own)
    assert np.mean(distances(line, fit) ** 2) < 0.7 * np.mean(distances(line, own) ** 2)
    np.testing.assert_allclose(fit_polyline(line[[0, 70]], tolerance), line[[0, 70]], atol=1e-12)


def wave() -> np.ndarray:
    t = np.linspace(0, 3, 200)
    return np.column_stack([0.1 * t, 0.02 * np.sin(3 * t), np.zeros(200)])


def distances(line: np.ndarray, simple: np.ndarray) -> np.ndarray:
    """Distance of a line's points from a chain of straight pieces."""
    return distance_to_shapes(line, [Stem(a, b, 1e-9, "main") for a, b in itertools.pairwise(simple)]).min(axis=1)
