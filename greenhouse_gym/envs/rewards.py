"""Rewards: from a `Transition` of n simulations to named terms, whose sum is the reward."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import reduce
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.contacts import CONTACT_GROUPS
from greenhouse_gym.envs.state import Bools, State
from greenhouse_gym.errors import InvalidValueError, is_number
from greenhouse_gym.geometry import Array


@dataclass(frozen=True, eq=False)
class Transition:
    """Step of n simulations, from which rewards are computed; all arrays are read-only.

    Attributes:
        before: (n,) distance to the goal before the step, metres; for reaching, from the grasp point to the target.
        after: (n,) distance to the goal after the step, metres.
        collided: (n,) whether a contact ended the episode in this step.
        success: (n,) whether the step solved the task, which ends the episode.
        effort: (n,) sum of squares of the action.
        steps: (n,) steps of the episode so far, including this one.
        states: States before and after the step; None in hindsight, when a goal environment evaluates a step with
            another goal. `start` and `end` read them.
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
        """State before the step.

        Raises:
            InvalidValueError: There is no state in hindsight.
        """
        return self._required_states()[0]

    @property
    def end(self) -> State:
        """State after the step.

        Raises:
            InvalidValueError: There is no state in hindsight.
        """
        return self._required_states()[1]

    def _required_states(self) -> tuple[State, State]:
        if self.states is None:
            raise InvalidValueError(
                "in hindsight a reward knows only before, after, collided, success, effort and steps, but this one "
                'reads a state: use these values, or choose observation="state"'
            )
        return self.states


Terms: TypeAlias = Mapping[str, Array]
Reward: TypeAlias = Callable[[Transition], Terms]
"""Function from n steps to terms by name, each (n,); the reward is their sum in this order.

If it has a true attribute ``requires_roadmap``, states contain `State.waypoint`, `State.path_length` and
`State.path_free`, whatever is observed.
"""


class StepResult(NamedTuple):
    """Result of one step of n simulations.

    Attributes:
        reward: (n,).
        terms: Terms of the reward by name, each (n,).
        terminated: (n,) success or failure.
        truncated: (n,) the step limit was reached without either.
        transition: The step from which the reward was computed.
    """

    reward: Array
    terms: Terms
    terminated: Bools
    truncated: Bools
    transition: Transition


@dataclass(frozen=True)
class SparseReward:
    """Reward at the end of an episode only.

    Attributes:
        success: Reward for a success.
        collision: Reward for a collision.
    """

    success: float = 1.0
    collision: float = -1.0

    def __post_init__(self) -> None:
        _check_finite(self)

    def __call__(self, step: Transition) -> dict[str, Array]:
        """Return the terms of n steps."""
        return {
            "success": np.where(step.success, self.success, 0.0),
            "collision": np.where(step.collided, self.collision, 0.0),
        }


@dataclass(frozen=True)
class DenseReward:
    """Reward with a term for progress.

    From the same start, every success returns more than any collision: progress telescopes to the same 4 d in both, and
    time and effort cost at most 8.2 (with 7 joints) of the 15 between them. A collision costs about as much as an
    episode without either, so that a policy is not paid to try.

    Attributes:
        success: Reward for a success.
        collision: Reward for a collision.
        progress: Reward per metre of progress toward the goal.
        time: Reward per step.
        effort: Factor of the sum of squares of the action.
    """

    success: float = 10.0
    collision: float = -5.0
    progress: float = 4.0
    time: float = -0.02
    effort: float = -0.003

    def __post_init__(self) -> None:
        _check_finite(self)

    def __call__(self, step: Transition) -> dict[str, Array]:
        """Return the terms of n steps."""
        return {
            "success": np.where(step.success, self.success, 0.0),
            "collision": np.where(step.collided, self.collision, 0.0),
            "progress": self.progress * (step.before - step.after),
            "time": np.full(len(step.after), self.time),
            "effort": self.effort * step.effort,
        }


@dataclass(frozen=True)
class PathReward(DenseReward):
    """Dense reward with progress along a collision-free path where one is known.

    A grasp point that approaches its goal in a straight line may run into leaves. The remaining path leads to the
    waypoint and from there to the goal, in joint space (`greenhouse_gym.motion.waypoints`). It is a potential (Ng,
    Harada and Russell: Policy invariance under reward transformations, 1999) without a discount, so the progress over
    an episode depends only on its start and end. The policy need not observe the waypoint. Goal environments cannot use
    it, because the path to a goal in hindsight is unknown.

    Attributes:
        collision: Reward for a collision.
        progress: Reward per radian by which the remaining path became shorter.
    """

    requires_roadmap: ClassVar[bool] = True
    collision: float = -1.0
    progress: float = 2.0

    def __call__(self, step: Transition) -> dict[str, Array]:
        """Return the terms of n steps."""
        return super().__call__(step) | {
            "progress": self.progress * (_remaining_path(step.start) - _remaining_path(step.end))
        }


def _remaining_path(state: State) -> Array:
    """Return the length (n,) of the path to the goal, radians, measured as in `greenhouse_gym.motion.waypoints`."""
    return np.asarray(np.sqrt((state.waypoint * state.waypoint).sum(axis=1)) + state.path_length)


def total_reward(terms: Terms) -> Array:
    """Return the sum (n,) of the terms in their order."""
    return np.asarray(reduce(np.add, terms.values()))


def with_contact_cost(terms: Terms, costs: Mapping[str, float], contacts: npt.NDArray[np.int64]) -> Terms:
    """Return the terms with a further term ``contact``.

    Args:
        terms: The terms of a reward.
        costs: Reward per contact by group, see `Task.costs`.
        contacts: (n, groups) contacts of the step.
    """
    weights = np.array([costs.get(group, 0.0) for group in CONTACT_GROUPS])
    return {**terms, "contact": (contacts * weights).sum(axis=1)}


def with_brush_cost(terms: Terms, cost: float, seconds: Array) -> Terms:
    """Return the terms with a further term ``brush`` for the seconds (n,) in which a leaf was touched."""
    return {**terms, "brush": cost * seconds}


def _check_finite(reward: Any) -> None:
    for field in fields(reward):
        value = getattr(reward, field.name)
        if not is_number(value):
            raise InvalidValueError(f"{type(reward).__name__}.{field.name} must be a finite number, got {value!r}")


REWARDS: dict[str, Reward] = {"sparse": SparseReward(), "dense": DenseReward(), "path": PathReward()}
"""Rewards by name."""
