"""Spheres refined in batches, and quantiles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from greenhouse_gym.shapes import ShapeSettings
from greenhouse_gym.shapes.fruit.spheres import NORMALS_KNOWN, ROUGHLY_KNOWN, SIZE_KNOWN, FitPrior, fit_spheres
from greenhouse_gym.shapes.robust_fit import quantiles

RADII = ShapeSettings().radii


def balls(count: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Half balls on a lattice of 10 cm: noisy points and normals, true spheres (k, 4), and perturbed ones."""
    rng = np.random.default_rng(1)
    k = np.arange(count)
    true = np.column_stack([k % 20, k // 20 % 20, k // 400, np.zeros(count)]) * 0.1
    true[:, 3] = rng.uniform(0.008, 0.045, count)
    points, normals = [], []
    for sphere in true:
        unit = rng.normal(size=(rng.integers(20, 900), 3))
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        unit[:, 0] = -np.abs(unit[:, 0])
        points.append(sphere[:3] + (sphere[3] + rng.normal(0.0, 0.0003, (len(unit), 1))) * unit)
        normals.append(unit)
    guesses = true + rng.normal(0.0, 0.06, true.shape) * true[:, 3:]
    return np.concatenate(points), np.concatenate(normals), true, guesses


def test_many_candidates_are_refined_to_the_truth_in_their_order() -> None:
    points, normals, true, guesses = balls()
    fits = fit_spheres(points, normals, guesses, RADII)
    assert len(fits) == len(true)
    found = np.array([[*fit.center, fit.radius] for fit in fits])
    assert np.linalg.norm(found[:, :3] - true[:, :3], axis=1).max() < 0.001
    assert np.abs(found[:, 3] / true[:, 3] - 1).max() < 0.03


@pytest.mark.parametrize("prior", [NORMALS_KNOWN, ROUGHLY_KNOWN, SIZE_KNOWN])
def test_a_sphere_does_not_depend_on_others_in_its_batch(prior: FitPrior) -> None:
    points, normals, _, guesses = balls()
    nothing = np.array([[9.0, 9.0, 9.0, 0.02], [0.05, 0.05, 0.0, 0.004], [0.0, 0.0, 0.0, 0.2]])
    together = fit_spheres(points, normals, np.concatenate([nothing, guesses]), RADII, prior)
    alone = [fit for guess in guesses[:12] for fit in fit_spheres(points, normals, guess[None], RADII, prior)]
    for one, other in zip(together, alone, strict=False):
        np.testing.assert_allclose([*one.center, one.radius], [*other.center, other.radius], atol=1e-9)
        np.testing.assert_array_equal(np.sort(one.points), np.sort(other.points))


def test_nothing_is_fitted_to_nothing() -> None:
    points, normals, _, guesses = balls(4)
    assert fit_spheres(points, normals, np.zeros((0, 4)), RADII) == []
    assert fit_spheres(points + 5.0, normals, guesses, RADII) == []


@given(st.lists(st.tuples(*2 * [st.floats(-9, 9)]), min_size=1, max_size=9), st.lists(st.floats(0, 1), min_size=1))
def test_quantiles_are_those_of_numpy(values: list, fractions: list) -> None:
    array = np.array(values)
    np.testing.assert_allclose(quantiles(array, np.array(fractions)), np.quantile(array, fractions, axis=0), atol=1e-12)
    np.testing.assert_allclose(quantiles(array[:, 0], 0.5), np.median(array[:, 0]), atol=1e-12)
