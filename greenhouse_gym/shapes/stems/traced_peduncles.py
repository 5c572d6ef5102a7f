"""Peduncles and pedicels traced through probable points, less the pieces that hardly any such point supports.

A path bridges what is occluded, and on a cloud unlike those the network was fitted to it may lead anywhere. The
probabilities along a piece distinguish both from visible stems.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.stems.bare_peduncles import find_bare_peduncles
from greenhouse_gym.shapes.stems.peduncles import find_peduncles

MIN_PROBABILITY, MIN_BARE_PROBABILITY = 0.2, 0.5
"""Probability of the points through which stems with and without detected fruit are traced."""

_MIN_SUPPORT = {"peduncle": 0.25, "pedicel": 0.4}
"""Least mean probability along a piece, chosen on rows 501, 932, 934 of Helios' plants and 302 of own ones."""

_SUPPORT_REACH, _SUPPORT_STEP = 0.005, 0.002  # metres from a piece to points that support it, and between samples


def trace_peduncles(
    nodes: Array, probability: Array, tomatoes: tuple[Tomato, ...], main: list[Stem], axis_tolerance: float
) -> list[Stem]:
    """Trace the peduncles and pedicels of detected fruit, then peduncles without detected fruit.

    Args:
        nodes: (n, 3) points on the axes of possible peduncles, metres.
        probability: (n,) that a node lies on a peduncle or pedicel.
        tomatoes: The fruits, with the trusses they hang on.
        main: The main stems.
        axis_tolerance: Largest distance of the capsules from the traced axis, metres.
    """
    found = find_peduncles(nodes[probability > MIN_PROBABILITY], tomatoes, main, axis_tolerance)
    bare = nodes[probability > MIN_BARE_PROBABILITY]
    found += find_bare_peduncles(bare, [*main, *found], axis_tolerance)
    support = _support(found, nodes, probability)
    return [stem for stem, own in zip(found, support, strict=True) if own >= _MIN_SUPPORT[stem.kind]]


def _support(stems: Sequence[Stem], nodes: Array, probability: Array) -> list[float]:
    """Return the mean over each stem's axis of the highest probability near it, 0 where no node is near."""
    tree = cKDTree(nodes)
    support = []
    for stem in stems:
        count = int(np.ceil(stem.length / _SUPPORT_STEP)) + 1
        along = (np.arange(count) + 0.5)[:, None] / count
        near = tree.query_ball_point(stem.start + along * (stem.end - stem.start), _SUPPORT_REACH)
        support.append(float(np.mean([probability[rows].max(initial=0.0) for rows in near])))
    return support
