"""What several looks at the same fruit agree upon."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from greenhouse_gym.shapes.spheres import APART, SphereFit, all_apart

_UNSEEN = 0.05  # how credible a fruit is to those that do not see it


class Find(NamedTuple):
    """A sphere that may be a tomato.

    Attributes:
        ball: Where it is; its points are rows of the cloud that it was found in.
        confidence: How credible it is, 0 to 1.
        ripeness: 0 to 1.
    """

    ball: SphereFit
    confidence: float
    ripeness: float


def agreed(looks: Sequence[Sequence[Find]], least: float) -> list[Find]:
    """The finds that are credible enough in the mean over all looks, each where the look that is surest sees it.

    Two finds are the same fruit if they are in one place; of overlapping ones the more credible is kept.
    """
    finds = sorted(((find, k) for k, look in enumerate(looks) for find in look), key=lambda one: -one[0].confidence)
    centers = np.array([find.ball.center for find, _ in finds]).reshape(-1, 3)
    radii, look = np.array([find.ball.radius for find, _ in finds]), np.array([k for _, k in finds])
    free = np.ones(len(finds), dtype=np.bool_)
    means = []
    for k, (find, own) in enumerate(finds):
        if not free[k]:
            continue
        away = np.linalg.norm(centers - find.ball.center, axis=1) / (radii + find.ball.radius)
        away[~free | (away > APART)] = np.inf
        others = [np.where(look == other, away, np.inf) for other in range(len(looks)) if other != own]
        same = [k, *(int(there.argmin()) for there in others if np.isfinite(there).any())]
        free[same] = False
        confidence = sum(finds[i][0].confidence for i in same) + _UNSEEN * (len(looks) - len(same))
        means.append(find._replace(confidence=confidence / len(looks)))
    chosen: list[Find] = []
    for find in sorted(means, key=lambda find: -find.confidence):
        if find.confidence >= least and all_apart(find.ball, [other.ball for other in chosen]):
            chosen.append(find)
    return chosen
