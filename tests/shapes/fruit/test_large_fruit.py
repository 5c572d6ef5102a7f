"""Scores of large fruit, and the curvature that fruit without neighbors needs."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.shapes import ShapeSettings
from greenhouse_gym.shapes.fruit.large_fruit import (
    SEED_WEIGHTS,
    Candidates,
    SphereClassifiers,
    large_fruit,
    shipped_classifiers,
)
from greenhouse_gym.shapes.fruit.sphere_features import CONTEXT_FEATURES, MAX_CONTRAST, SHELL_FEATURES, SPHERE_FEATURES
from greenhouse_gym.shapes.fruit.spheres import SphereFit
from greenhouse_gym.shapes.surface_cloud import SurfaceCloud

COLUMNS = len(SPHERE_FEATURES) + len(CONTEXT_FEATURES) + len(SHELL_FEATURES)


def constant(value: float):
    return lambda features: np.full(len(features), value)


def candidate(**features: float) -> Candidates:
    """One sphere of the first pass with some features, and none of the second."""
    points = np.zeros((40, 3))
    cloud = SurfaceCloud(
        points, points, points, np.zeros((40, 2)), np.zeros(40), np.zeros(40), np.zeros(40), -0.15, 0.02
    )
    ball = SphereFit(np.array([0.5, 0.0, 1.2]), 0.02, np.arange(40), 0.3, 0.001, 0.9)
    first = np.zeros((1, COLUMNS))
    for name, value in features.items():
        first[0, [*SPHERE_FEATURES, *CONTEXT_FEATURES].index(name.replace("_", " "))] = value
    return Candidates(cloud, [ball], first, [], np.zeros((0, COLUMNS)))


def test_the_regression_uses_the_features_of_single_spheres() -> None:
    assert len(SEED_WEIGHTS) - 1 == len(SPHERE_FEATURES)


@pytest.mark.parametrize("classifier", shipped_classifiers())
def test_shipped_networks_score_all_features(classifier) -> None:
    scores = classifier(np.random.default_rng(0).normal(size=(7, COLUMNS)))
    assert scores.shape == (7,)
    assert ((scores >= 0) & (scores <= 1)).all()
    assert np.ptp(scores) > 0


def test_confidence_is_the_classifiers_score() -> None:
    found = large_fruit(candidate(neighbors=1.0), ShapeSettings(), SphereClassifiers(constant(0.6), constant(0.0)))
    np.testing.assert_allclose(found.confidence, 0.6)


@pytest.mark.parametrize(
    ("contrast", "score", "neighbors", "curvature", "kept"),
    [
        (MAX_CONTRAST, 0.9, 0.0, 0.0, True),  # red and confident: however little of it shows
        (MAX_CONTRAST, 0.7, 0.0, 0.0, False),  # red, but not confident
        (0.1, 0.99, 0.0, 0.0, False),  # as green as a leaf, and not more curved
        (0.1, 0.5, 0.0, 1.0, True),  # curved like a ball
        (0.1, 0.5, 1.0, 0.0, True),  # next to confident fruit
    ],
)
def test_fruit_without_neighbors_is_curved_or_red(
    contrast: float, score: float, neighbors: float, curvature: float, kept: bool
) -> None:
    one = candidate(contrast=contrast, neighbors=neighbors, smaller_curvature=curvature)
    one.first_features[0, SPHERE_FEATURES.index("patch's smaller curvature")] = curvature
    classifiers = SphereClassifiers(constant(score), constant(0.0))
    assert (len(large_fruit(one, ShapeSettings(), classifiers).fits) == 1) == kept
