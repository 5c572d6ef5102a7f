"""Probabilities around a candidate point as features of a second network."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.shapes.stems.peduncle_features import FEATURES, PeduncleCandidates
from greenhouse_gym.shapes.stems.traced_peduncles import CONTEXT, peduncle_probability, with_context

LINE = 30


def scene(seed: int = 0) -> tuple[PeduncleCandidates, np.ndarray]:
    """A slanted line of probable points among scattered improbable ones."""
    rng = np.random.default_rng(seed)
    along = np.linspace(0.0, 0.11, LINE)
    line = np.column_stack([0.6 + 0.3 * along, 0.1 + 0.2 * along, 1.1 + along])
    scattered = rng.uniform([0.5, 0.0, 1.0], [0.7, 0.2, 1.3], (400, 3))
    nodes = np.concatenate([line, scattered])
    first = np.concatenate([rng.uniform(0.6, 0.9, LINE), rng.uniform(0.0, 0.3, 400)])
    return PeduncleCandidates(nodes, rng.normal(size=(len(nodes), len(FEATURES)))), first


def read(features: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(CONTEXT, features[:, len(FEATURES) :].T, strict=True))


def test_a_line_of_probable_points_stands_out() -> None:
    candidates, first = scene()
    features = with_context(candidates, first)
    np.testing.assert_array_equal(features[:, : len(FEATURES)], candidates.features)
    found = read(features)
    on, off = slice(3, LINE - 3), slice(LINE, None)
    for reach in ("10 mm", "20 mm", "30 mm"):
        assert found[f"linear, {reach}"][on].min() > 0.5
        assert found[f"off line, {reach}"][on].max() < 0.2
        assert found[f"sum, {reach}"][on].min() > np.median(found[f"sum, {reach}"][off])
    up = 1.0 / np.sqrt(1 + 0.3**2 + 0.2**2)
    assert found["upright, 30 mm"][on] == pytest.approx(up, abs=0.2)
    assert np.corrcoef(found["own"], first)[0, 1] > 0.9


def test_features_depend_on_neither_order_nor_pose() -> None:
    candidates, first = scene()
    features = with_context(candidates, first)
    order = np.random.default_rng(1).permutation(len(first))
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    moved = PeduncleCandidates((candidates.nodes @ turn.T + [2.0, -3.0, 0.5])[order], candidates.features[order])
    again = read(with_context(moved, first[order]))
    for name, values in read(features).items():
        np.testing.assert_allclose(again[name], values[order], atol=1e-4, err_msg=name)


def test_one_candidate_and_none() -> None:
    candidates, first = scene()
    alone = with_context(PeduncleCandidates(candidates.nodes[:1], candidates.features[:1]), first[:1])
    assert np.isfinite(alone).all()
    nothing = PeduncleCandidates(np.zeros((0, 3)), np.zeros((0, len(FEATURES))))
    assert with_context(nothing, np.zeros(0)).shape == (0, len(FEATURES) + len(CONTEXT))
    assert peduncle_probability(nothing).shape == (0,)
    for extreme in (0.0, 1.0):
        assert np.isfinite(with_context(candidates, np.full(len(first), extreme))).all()


def test_probabilities_are_between_zero_and_one() -> None:
    candidates, _ = scene()
    found = peduncle_probability(candidates)
    assert found.shape == (len(candidates.nodes),)
    assert ((found >= 0.0) & (found <= 1.0)).all()
