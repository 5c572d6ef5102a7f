"""What a step is worth: from a `Transition` of n simulations to named terms, whose sum is the reward."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import reduce
from typing import Any, ClassVar, TypeAlias

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.reach_task import Bools, State
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array


@dataclass(frozen=True, eq=False)
class Transition:
    """What the reward of n steps may depend on; all arrays are to be read only.

    Attributes:
        before: (n,) distance from the grasp point to its goal before the step, metres.
        after: (n,) that distance after the step.
        collided: (n,) whether anything was touched in the step, which ends the episode.
        success: (n,) whether the grasp point arrived and nothing was touched, which ends the episode.
        effort: (n,) sum of the squares of the action's entries.
        steps: (n,) steps of the episode so far, this one included.
        states: What the simulations looked like before and after, or None in hindsight: when a goal environment
            asks what a step would have been worth with another goal. `start` and `end` read them.
    """

    before: Array
    after: Array
    collided: Bools
    success: Bools
    effort: Array
    steps: npt.NDArray[np.int64]
    states: tuple[State, State] | None = None

    @property
    def start(self) -> State:
        """What the simulations looked like before the step.

        Raises:
            InvalidValueError: In hindsight.
        """
        return self._known()[0]

    @property
    def end(self) -> State:
        """What the simulations look like after the step.

        Raises:
            InvalidValueError: In hindsight.
        """
        return self._known()[1]

    def _known(self) -> tuple[State, State]:
        if self.states is None:
            raise InvalidValueError(
                "in hindsight a reward knows before, after, collided, success, effort and steps only, not the "
                'states it read: write it with these, or choose observation="state"'
            )
        return self.states


Terms: TypeAlias = Mapping[str, Array]
Reward: TypeAlias = Callable[[Transition], Terms]
"""From n steps to terms by name, each (n,); the reward is their sum, in their order.

A reward with an attribute ``requires_roadmap`` that is true is told where the arm can go straight (`State.waypoint` and
`State.path_length`), whatever is observed.
"""


@dataclass(frozen=True)
class SparseReward:
    """A reward that is paid only at the end of an episode.

    Attributes:
        success: What a success is worth.
        collision: What a collision is worth.
    """

    success: float = 1.0
    collision: float = -1.0

    def __post_init__(self) -> None:
        _check_finite(self)

    def __call__(self, step: Transition) -> dict[str, Array]:
        """The terms of n steps."""
        return {
            "success": np.where(step.success, self.success, 0.0),
            "collision": np.where(step.collided, self.collision, 0.0),
        }


@dataclass(frozen=True)
class DenseReward:
    """A reward that is also paid for progress.

    From one start, every success returns more than any crash: progress telescopes to the same 4 d in both, and time
    and effort cost at most 8.2 (with 7 joints) of the 11 between them.

    Attributes:
        success: What a success is worth.
        collision: What a collision is worth.
        progress: What each metre is worth by which the grasp point came nearer to its goal.
        time: What each step is worth.
        effort: What the sum of the squares of the action's entries is multiplied by.
    """

    success: float = 10.0
    collision: float = -1.0
    progress: float = 4.0
    time: float = -0.02
    effort: float = -0.003

    def __post_init__(self) -> None:
        _check_finite(self)

    def __call__(self, step: Transition) -> dict[str, Array]:
        """The terms of n steps."""
        return {
            "success": np.where(step.success, self.success, 0.0),
            "collision": np.where(step.collided, self.collision, 0.0),
            "progress": self.progress * (step.before - step.after),
            "time": np.full(len(step.after), self.time),
            "effort": self.effort * step.effort,
        }


@dataclass(frozen=True)
class PathReward(DenseReward):
    """As `DenseReward`, but for the progress, which is made along a way that is free, as far as one is known.

    A grasp point that comes nearer to its goal may be on its way into the leaves. The way that is left is that to the
    waypoint and from there to the goal, in joint space (`greenhouse_gym.motion.roadmap`). It is a potential (Ng, Harada
    and Russell: Policy invariance under reward transformations, 1999), without a discount, so that what is paid over an
    episode depends on its beginning and its end alone. The learner is told of it in training, the policy only if it
    observes the waypoint, too. A goal environment cannot have it: no way to a goal in hindsight is known.

    Attributes:
        progress: What each radian is worth by which the way that is left became shorter.
    """

    requires_roadmap: ClassVar[bool] = True
    progress: float = 2.0

    def __call__(self, step: Transition) -> dict[str, Array]:
        """The terms of n steps."""
        return super().__call__(step) | {"progress": self.progress * (_left(step.start) - _left(step.end))}


def _left(state: State) -> Array:
    """(n,) the way that is left, radians, measured as in `greenhouse_gym.motion.waypoints`."""
    return np.asarray(np.sqrt((state.waypoint * state.waypoint).sum(axis=1)) + state.path_length)


def total_reward(terms: Terms) -> Array:
    """(n,) sum of the terms, in their order."""
    return np.asarray(reduce(np.add, terms.values()))


def _check_finite(reward: Any) -> None:
    for field in fields(reward):
        value = getattr(reward, field.name)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
            raise InvalidValueError(f"{type(reward).__name__}.{field.name} must be a finite number, got {value!r}")


REWARDS: dict[str, Reward] = {"sparse": SparseReward(), "dense": DenseReward(), "path": PathReward()}
"""Rewards by name."""
