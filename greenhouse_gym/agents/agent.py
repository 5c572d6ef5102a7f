"""What an agent is: something that is told the problem at an episode's start and then acts on observations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.envs.actions import INTERVAL, ActionRule, JointIncrements, JointVelocities
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene


@dataclass(frozen=True, eq=False)
class Problem:
    """What an agent may know at an episode's start.

    Attributes:
        scene: The scene as it was reconstructed.
        target: Index of the target tomato in the scene.
        robot: The arm.
        start: (joints,) start configuration, radians.
        seed: Seed for the agent's own random choices in this episode.
        action: What the environment makes of actions; None stands for its default, increments of the joints.
        interval: Seconds from one action to the next.
    """

    scene: Scene
    target: int
    robot: Robot
    start: Array
    seed: int = 0
    action: ActionRule | None = None
    interval: float = INTERVAL

    @property
    def action_space(self) -> spaces.Box:
        """The space of an action, which has one axis."""
        return self._rule.space

    @property
    def joint_steps(self) -> Array:
        """(joints,) what an action of 1 adds to each joint's command, radians.

        Raises:
            InvalidValueError: The environment's actions are no motions of the joints.
        """
        rule = self._rule
        if not isinstance(rule, JointIncrements | JointVelocities):
            raise InvalidValueError(
                f"a joint path can be followed with action='joint' or 'joint_velocity' only, got {type(rule).__name__}"
            )
        return rule.peak

    @property
    def _rule(self) -> ActionRule:
        return JointIncrements(self.robot, self.interval) if self.action is None else self.action


@runtime_checkable
class Agent(Protocol):
    """A reaching agent, scripted, planned or learned.

    An agent without memory may also have a method ``act_many(observations)`` that gives actions (n, size) for the
    observations of n simulations at once. It is then asked for all of them together where many run side by side;
    of any other agent every simulation gets a copy.

    Attributes:
        name: How it is called in tables.
        env_options: Keywords for `gymnasium.make` that give the environment this agent needs.
    """

    name: str
    env_options: Mapping[str, Any]

    def reset(self, problem: Problem) -> None:
        """Prepare for an episode."""

    def act(self, observation: Any) -> npt.NDArray[np.floating[Any]]:
        """The next action, (size,), within `Problem.action_space`: [-1, 1] unless the environment has its own."""


def check_agent(agent: object) -> None:
    """Raise an error unless something is an `Agent`.

    Raises:
        InvalidValueError: It is a class, or an attribute of an agent is missing.
    """
    called = getattr(agent, "name", type(agent).__name__)
    if isinstance(agent, type):
        raise InvalidValueError(f"{agent.__name__} is a class: an agent is an object, such as {agent.__name__}()")
    kinds: dict[str, Callable[[object], bool]] = {
        "name": lambda value: isinstance(value, str),
        "env_options": lambda value: isinstance(value, Mapping),
        "reset": callable,
        "act": callable,
    }
    for attribute, fits in kinds.items():
        if not fits(getattr(agent, attribute, None)):
            raise InvalidValueError(
                f"{called!r} is no agent: its {attribute!r} is missing or of the wrong kind; an agent has a name, "
                "env_options (a mapping), reset(problem) and act(observation)"
            )
