"""What the likelihoods around a place say: places on a line of likely ones stand out, whatever the frame and order."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.shapes.likely_places import CONTEXT, in_context, likelihood
from greenhouse_gym.shapes.thin_stems import MEASURES, Places

LINE = 30


def scene(seed: int = 0) -> tuple[Places, np.ndarray]:
    """A slanted line of likely places among places of all likelihoods that are strewn about."""
    rng = np.random.default_rng(seed)
    along = np.linspace(0.0, 0.11, LINE)
    line = np.column_stack([0.6 + 0.3 * along, 0.1 + 0.2 * along, 1.1 + along])
    strewn = rng.uniform([0.5, 0.0, 1.0], [0.7, 0.2, 1.3], (400, 3))
    nodes = np.concatenate([line, strewn])
    first = np.concatenate([rng.uniform(0.6, 0.9, LINE), rng.uniform(0.0, 0.3, 400)])
    return Places(nodes, rng.normal(size=(len(nodes), len(MEASURES)))), first


def read(measured: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(CONTEXT, measured[:, len(MEASURES) :].T, strict=True))


def test_places_on_a_line_of_likely_ones_stand_out() -> None:
    places, first = scene()
    measured = in_context(places, first)
    np.testing.assert_array_equal(measured[:, : len(MEASURES)], places.measures)
    found = read(measured)
    on, off = slice(3, LINE - 3), slice(LINE, None)
    for reach in ("10 mm", "20 mm", "30 mm"):
        assert found[f"linear, {reach}"][on].min() > 0.5
        assert found[f"off line, {reach}"][on].max() < 0.2
        assert found[f"sum, {reach}"][on].min() > np.median(found[f"sum, {reach}"][off])
    up = 1.0 / np.sqrt(1 + 0.3**2 + 0.2**2)
    assert found["upright, 30 mm"][on] == pytest.approx(up, abs=0.2)
    assert np.corrcoef(found["by itself"], first)[0, 1] > 0.9


def test_neither_order_nor_place_nor_heading_counts() -> None:
    places, first = scene()
    measured = in_context(places, first)
    order = np.random.default_rng(1).permutation(len(first))
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    moved = Places((places.nodes @ turn.T + [2.0, -3.0, 0.5])[order], places.measures[order])
    again = read(in_context(moved, first[order]))
    for name, values in read(measured).items():
        np.testing.assert_allclose(again[name], values[order], atol=1e-4, err_msg=name)


def test_a_place_alone_and_none_at_all() -> None:
    places, first = scene()
    alone = in_context(Places(places.nodes[:1], places.measures[:1]), first[:1])
    assert np.isfinite(alone).all()
    nothing = Places(np.zeros((0, 3)), np.zeros((0, len(MEASURES))))
    assert in_context(nothing, np.zeros(0)).shape == (0, len(MEASURES) + len(CONTEXT))
    assert likelihood(nothing).shape == (0,)
    for extreme in (0.0, 1.0):
        assert np.isfinite(in_context(places, np.full(len(first), extreme))).all()


def test_likelihoods_are_shares() -> None:
    places, _ = scene()
    found = likelihood(places)
    assert found.shape == (len(places.nodes),)
    assert ((found >= 0.0) & (found <= 1.0)).all()
