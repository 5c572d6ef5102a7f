"""What is told about the ways of an arm that sees with its wrist's camera, and who says from that which are free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.agents.sight_map import SightMap
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.arm_spheres import PARTS

RESOLUTION = 0.04
"""How far any point of the arm may move between the configurations of a way that are looked at, metres."""

ROOM = (-0.005, 0.02)
"""Clearances are told within these bounds, metres: what is nearer is blocked, and what is farther does not count."""

DEEP = 0.25
"""How far before the target's depth the plants are taken to begin, metres."""

_CLOSE = 0.015  # metres: nearer than this is close

FEATURES: tuple[tuple[str, int], ...] = (
    ("nearest", 1), ("clearance", len(PARTS)), ("end_clearance", len(PARTS)), ("close", len(PARTS)),
    ("unseen_deep", len(PARTS)), ("unseen_before", len(PARTS)), ("looks", 1), ("way", 2),
)  # fmt: skip
"""What is told about a way: how near the arm comes to what was seen, at all, and by `PARTS` on the way and at its end;
how much of the way it is close to that, and in space not seen, among the plants and before them, metres; from how many
places it has looked; the length of the way, radians, and of how many motions it is made."""


def guessed(features: npt.NDArray[np.float32]) -> Array:
    """Chances (n,) of ways to be free, by a rule in which nothing is learned: they keep away from what was seen."""
    nearest = features[:, 0].astype(np.float64)
    unseen = features[:, 1 + 3 * len(PARTS) : 1 + 4 * len(PARTS)].sum(axis=1)
    return np.asarray(np.exp(-unseen) / (1.0 + np.exp((0.005 - nearest) / 0.001)))


@dataclass(frozen=True, eq=False)
class Judge:
    """Says by a network what the chances of ways are.

    Attributes:
        network: From the features to a number from -1, surely not free, to 1, surely free.
    """

    network: Policy

    def __call__(self, features: npt.NDArray[np.float32]) -> Array:
        """Chances (n,) of ways with features (n, f)."""
        return np.asarray(0.5 + 0.5 * self.network(features)[:, 0], dtype=np.float64)


def features_of(
    seen: SightMap, target: Array, looks: int, start: Array, ways: Sequence[Array]
) -> npt.NDArray[np.float32]:
    """What is told about ways, see `FEATURES`, (n, f).

    Args:
        seen: What the arm has seen so far.
        target: (3,) the target's center, metres.
        looks: From how many places it has looked, its start among them.
        start: (j,) where the ways begin, radians.
        ways: For each the (k, j) configurations that it leads to on straight motions, radians.
    """
    configurations = [between(seen.arm.checker.reaches, np.array([start, *way])) for way in ways]
    around = seen.around(np.concatenate(configurations))
    counts = np.array([len(part) for part in configurations])
    first = np.cumsum(counts) - counts
    near = np.clip(
        np.stack([around.clearance[:, seen.arm.part == part].min(axis=1) for part in range(len(PARTS))]), *ROOM
    )
    deep = around.centers[..., 0] > target[0] - DEEP
    dark = [
        np.stack([(around.unknown & where)[:, seen.arm.part == part].mean(axis=1) for part in range(len(PARTS))])
        for where in (deep, ~deep)
    ]
    parts = [np.minimum.reduceat(near, first, axis=1), near[:, first + counts - 1]]
    parts += [RESOLUTION * np.add.reduceat(some, first, axis=1) for some in (1.0 * (near < _CLOSE), *dark)]
    sizes = [[float(looks), length(start, way), float(len(way))] for way in ways]
    told = [parts[0].min(axis=0)[None], *parts, np.transpose(sizes)]
    return np.concatenate(told).T.astype(np.float32)


def length(start: Array, way: Array) -> float:
    """Length of a way (k, j) from a configuration, radians."""
    return float(np.sqrt((np.diff(way, axis=0, prepend=start[None]) ** 2).sum(axis=1)).sum())


def between(reaches: Array, points: Array) -> Array:
    """(m, j) configurations on the straight motions from each of some points (k, j) to the next, the last one last."""
    steps = np.ceil(np.abs(np.diff(points, axis=0)) @ reaches / RESOLUTION).astype(int) + 1
    legs = [
        a + np.linspace(0, 1, n, endpoint=False)[:, None] * (b - a)
        for (a, b), n in zip(pairwise(points), steps, strict=True)
    ]
    return np.concatenate([*legs, points[-1:]])
