"""Rewards and terminations of steps with other goals, for hindsight experience replay."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.contacts import CONTACT_GROUPS
from greenhouse_gym.envs.rewards import Reward, Transition, total_reward, with_brush_cost, with_contact_cost
from greenhouse_gym.envs.state import Bools
from greenhouse_gym.envs.task import GoalTask
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array

Info = Mapping[str, Any] | Sequence[Mapping[str, Any]] | npt.NDArray[Any] | None


class Relabeled(NamedTuple):
    """Rewards and ends of n steps with other goals.

    Attributes:
        reward: (n,).
        terminated: (n,).
        truncated: (n,).
    """

    reward: Array
    terminated: Bools
    truncated: Bools


def relabel(
    achieved: npt.ArrayLike,
    desired: npt.ArrayLike,
    info: Info,
    task: GoalTask,
    reward: Reward,
    step_limit: int,
    brush_cost: float | None = None,
) -> Relabeled:
    """Evaluate steps with other goals; everything else is read from their infos.

    Args:
        achieved: (3,) or (n, 3) achieved goals after the step, metres.
        desired: (3,) or (n, 3) desired goals, metres.
        info: Info of the step, or one for each step.
        task: The task.
        reward: The reward.
        step_limit: Steps after which an episode is truncated.
        brush_cost: Reward per second in which a leaf is touched; None if leaves are rigid.

    Raises:
        InvalidValueError: An info lacks a key that the steps of a goal environment have.
    """
    reached, goals = (np.atleast_2d(np.asarray(points, dtype=np.float64)) for points in (achieved, desired))
    single = info is None or isinstance(info, Mapping)
    infos: list[Any] = [info] if single else list(info)  # type: ignore[arg-type]
    if not single and len(infos) != len(reached):
        raise InvalidValueError(f"expected an info for each of {len(reached)} goals, got {len(infos)}")

    def from_info(key: str) -> npt.NDArray[Any]:
        try:
            return np.array([one[key] for one in infos])
        except (KeyError, IndexError, TypeError):
            raise InvalidValueError(
                f"info must be that of a step and contain {key!r}; with Stable-Baselines3 pass copy_info_dict=True to "
                "HerReplayBuffer"
            ) from None

    collided, steps = from_info("collision").astype(np.bool_), from_info("steps")
    previous = from_info("previous_goal").astype(np.float64).reshape(-1, 3)
    outcome = task.evaluate_goals(reached, goals, collided)
    transition = Transition(
        before=task.evaluate_goals(previous, goals, collided).distance,
        after=outcome.distance,
        collided=collided,
        success=outcome.success,
        effort=from_info("effort").astype(np.float64),
        steps=steps,
    )
    terms = reward(transition)
    if task.costs:
        contacts = np.array([[counts[group] for group in CONTACT_GROUPS] for counts in from_info("contacts")])
        terms = with_contact_cost(terms, task.costs, contacts)
    if brush_cost is not None:
        terms = with_brush_cost(terms, brush_cost, from_info("brushing"))
    terminated = outcome.success | outcome.failure
    return Relabeled(total_reward(terms), terminated, (steps >= step_limit) & ~terminated)


def add_goal_functions(env: Any) -> None:
    """Add the methods ``compute_reward``, ``compute_terminated`` and ``compute_truncated`` to a goal environment.

    Other environments stay without them, because libraries recognize goal environments by these methods. Each takes
    achieved and desired goals and infos, as `relabel` does, and returns a number for one goal or (n,) for many.
    """
    if not env.simulation.observe.has_goals:
        return
    simulation = env.simulation
    rules = simulation.task, simulation.reward_terms, simulation.step_limit, simulation.brush_cost

    def function(part: str) -> Callable[[npt.ArrayLike, npt.ArrayLike, Info], Any]:
        def compute(achieved_goal: npt.ArrayLike, desired_goal: npt.ArrayLike, info: Info) -> Any:
            values = getattr(relabel(achieved_goal, desired_goal, info, *rules), part)
            return values.item() if np.ndim(achieved_goal) == 1 else values

        return compute

    for part in Relabeled._fields:
        setattr(env, "compute_" + part, function(part))
