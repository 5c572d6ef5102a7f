"""Peduncles and pedicels that probable points support, and those that a path only invents."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Array, Sphere
from greenhouse_gym.shapes.stems.traced_peduncles import trace_peduncles

FRUIT = (Tomato(Sphere([0.40, 0.2, 1.0], 0.025), 0),)
MAIN = [Stem([0.5, 0.2, 0.6], [0.5, 0.2, 1.4], 0.006, "main")]
PEDUNCLE = np.linspace([0.492, 0.2, 1.08], [0.41, 0.2, 1.06], 30)
PEDICEL = np.linspace([0.41, 0.2, 1.06], [0.40, 0.2, 1.028], 12)
NODES = np.concatenate([PEDUNCLE, PEDICEL])


def length(stems: list[Stem], kind: str) -> float:
    return sum(stem.length for stem in stems if stem.kind == kind)


def trace(probability: Array) -> list[Stem]:
    return trace_peduncles(NODES, probability, FRUIT, MAIN, 0.003)


@pytest.mark.parametrize("pedicel", [0.9, 0.25])
def test_a_pedicel_through_doubtful_points_is_not_reported(pedicel: float) -> None:
    stems = trace(np.repeat([0.9, pedicel], [len(PEDUNCLE), len(PEDICEL)]))
    assert length(stems, "peduncle") == pytest.approx(0.07, abs=0.03)
    assert (length(stems, "pedicel") > 0.015) == (pedicel > 0.5)


def test_a_bridge_over_an_occluded_centimetre_is_kept() -> None:
    seen = np.abs(NODES[:, 0] - 0.45) > 0.005
    stems = trace_peduncles(NODES[seen], np.full(seen.sum(), 0.9), FRUIT, MAIN, 0.003)
    assert length(stems, "peduncle") + length(stems, "pedicel") == pytest.approx(0.12, abs=0.02)


def test_nothing_probable_gives_nothing() -> None:
    assert trace(np.full(len(NODES), 0.1)) == []
    assert trace_peduncles(np.zeros((0, 3)), np.zeros(0), (), [], 0.003) == []
