"""Rewards and ends of episodes from goals alone, as hindsight experience replay asks for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.reach_task import Bools, lengths
from greenhouse_gym.envs.rewards import Reward, Transition, total_reward
from greenhouse_gym.envs.settings import EnvSettings
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array

Info = Mapping[str, Any] | Sequence[Mapping[str, Any]] | npt.NDArray[Any]


class Verdict(NamedTuple):
    """What n steps were worth had their goals been others.

    Attributes:
        reward: (n,).
        terminated: (n,).
        truncated: (n,).
    """

    reward: Array
    terminated: Bools
    truncated: Bools


def judge(
    achieved: npt.ArrayLike, desired: npt.ArrayLike, info: Info, reward: Reward, settings: EnvSettings
) -> Verdict:
    """Judge steps by their goals; everything else that counts is read from their infos.

    Args:
        achieved: (3,) or (n, 3) grasp points after the step, metres.
        desired: (3,) or (n, 3) centers to reach, metres.
        info: The step's info, or one per step.
        reward: The reward.
        settings: What counts as a success, and when a step is the last.

    Raises:
        InvalidValueError: An info lacks what a goal environment's steps tell.
    """
    goals = np.atleast_2d(np.asarray(desired, dtype=np.float64))
    infos = [info] if isinstance(info, Mapping) else list(info)

    def told(key: str) -> npt.NDArray[Any]:
        try:
            return np.array([one[key] for one in infos])
        except (KeyError, IndexError, TypeError):
            raise InvalidValueError(
                f"info must be that of a step and hold {key!r}; with Stable-Baselines3 pass copy_info_dict=True to "
                "HerReplayBuffer"
            ) from None

    collided, steps = told("collision").astype(np.bool_), told("steps")
    after = lengths(goals - np.atleast_2d(np.asarray(achieved, dtype=np.float64)))
    transition = Transition(
        before=lengths(goals - told("previous_goal").astype(np.float64).reshape(-1, 3)),
        after=after,
        collided=collided,
        success=(after < settings.success_radius) & ~collided,
        effort=told("effort").astype(np.float64),
        steps=steps,
    )
    terminated = transition.success | collided
    return Verdict(total_reward(reward(transition)), terminated, (steps >= settings.step_limit) & ~terminated)


GoalFunction = Callable[[npt.ArrayLike, npt.ArrayLike, Info], Any]


def goal_functions(reward: Reward, settings: EnvSettings) -> tuple[GoalFunction, GoalFunction, GoalFunction]:
    """The methods ``compute_reward``, ``compute_terminated`` and ``compute_truncated`` of a goal environment.

    Each takes achieved and desired goals and the info as `judge` does, and gives a number for one goal and an array
    (n,) for many.
    """

    def function(part: str) -> GoalFunction:
        def compute(achieved_goal: npt.ArrayLike, desired_goal: npt.ArrayLike, info: Info) -> Any:
            values = getattr(judge(achieved_goal, desired_goal, info, reward, settings), part)
            return values.item() if np.ndim(achieved_goal) == 1 else values

        return compute

    return function("reward"), function("terminated"), function("truncated")
