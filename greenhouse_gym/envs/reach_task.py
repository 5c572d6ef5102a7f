"""The task, as functions over arrays of n simulations: what they look like, success and reward.

Everything is elementwise, so a simulation's numbers do not depend on how many are computed at once. Points and
directions are in the frame of the arm's base: x forward to the plants, z up, origin at the base.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array

Float32: TypeAlias = npt.NDArray[np.float32]
Bools: TypeAlias = npt.NDArray[np.bool_]

SUCCESS_RADIUS = 0.02
"""The grasp point this near to the target's center is a success, metres."""

STEP_LIMIT = 200
"""Steps after which an episode is truncated."""

SUBSTEPS = 5
"""Physics steps of 10 ms per action: 20 actions per second."""

ACTION_STEP = 0.08
"""What an action of 1 adds to a joint's command, radians."""

MAX_LEAD = 0.2
"""How far a command may lie from the measured joint, radians; at full speed the arm follows 0.1 rad behind."""


class Situation(NamedTuple):
    """What n simulations look like at one moment.

    Attributes:
        joints: (n, j) joint positions as the encoders tell them, radians.
        velocities: (n, j) joint velocities, rad/s.
        lead: (n, j) last commanded minus measured positions, radians.
        tip: (n, 3) middle of the cup, metres.
        axis: (n, 3) unit vector along the tool.
        grasp: (n, 3) grasp point, metres.
        target: (n, 3) center of the target as the agent knows it, metres.
        distance: (n,) from the grasp point to the center of what has to be reached, metres.
        clearance: (n, k) from the arm's surface at its probe points to the nearest obstacle, metres.
        obstacle: (n, k, 3) unit vectors from the probe points towards that obstacle, zero where it is far.
        touched: (n,) whether anything was touched in any substep since the last situation.
        depth: (n, c, h, w) depth along the view, metres, of c cameras; 0 where there is no reading; c is 0 without any.
        views: (n, c, 4, 4) poses of the cameras, base_from_camera.
    """

    joints: Array
    velocities: Array
    lead: Array
    tip: Array
    axis: Array
    grasp: Array
    target: Array
    distance: Array
    clearance: Float32
    obstacle: Float32
    touched: Bools
    depth: Float32
    views: Array

    @property
    def success(self) -> Bools:
        """(n,) whether the grasp point is at the target and nothing was touched."""
        return np.asarray((self.distance < SUCCESS_RADIUS) & ~self.touched)

    def select(self, ids: npt.NDArray[np.int64]) -> Situation:
        """The situation of some of the simulations."""
        return Situation._make(values[ids] for values in self)

    def replaced(self, ids: npt.NDArray[np.int64], fresh: Situation) -> Situation:
        """A copy with the ``fresh`` situation of some of the simulations."""
        result = Situation._make(old.copy() for old in self)
        for name in self._fields:
            getattr(result, name)[ids] = getattr(fresh, name)
        return result


@dataclass(frozen=True, eq=False)
class Transition:
    """What the reward of n steps depends on.

    Attributes:
        before: (n,) distance from the grasp point to its goal before the step, metres.
        after: (n,) the same after it.
        touched: (n,) whether anything was touched in the step.
        effort: (n,) sum of the squares of the action's entries.
    """

    before: Array
    after: Array
    touched: Bools
    effort: Array

    @cached_property
    def success(self) -> Bools:
        """(n,) whether the grasp point arrived and nothing was touched."""
        return np.asarray((self.after < SUCCESS_RADIUS) & ~self.touched)


def sparse_terms(step: Transition) -> dict[str, Array]:
    """+1 for success, -1 for a collision."""
    return {"success": np.where(step.success, 1.0, 0.0), "collision": np.where(step.touched, -1.0, 0.0)}


def dense_terms(step: Transition) -> dict[str, Array]:
    """Success +10, collision -1, progress 4 per metre, time -0.02 per step, effort -0.003 |action|^2.

    From one start, every success returns more than any crash: progress telescopes to the same 4 d in both, and time
    and effort cost at most 8.2 (with 7 joints) of the 11 between them.
    """
    return {
        "success": 10.0 * step.success,
        "collision": 0.0 - step.touched,
        "progress": 4.0 * (step.before - step.after),
        "time": np.full(len(step.after), -0.02),
        "effort": -0.003 * step.effort,
    }


RewardTerms: TypeAlias = Callable[[Transition], dict[str, Array]]

REWARDS: dict[str, RewardTerms] = {"sparse": sparse_terms, "dense": dense_terms}
"""Reward terms, each (n,), by the reward's name; the reward is their sum, in their order."""


def total_reward(terms: dict[str, Array]) -> Array:
    """(n,) sum of the terms, in their order."""
    return np.asarray(reduce(np.add, terms.values()))


def lengths(vectors: Array) -> Array:
    """(n,) lengths of vectors (n, 3)."""
    squares = vectors * vectors
    return np.asarray(np.sqrt(squares[:, 0] + squares[:, 1] + squares[:, 2]))
