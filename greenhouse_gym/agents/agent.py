"""What an agent is: something that is told the problem at an episode's start and then acts on observations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

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
    """

    scene: Scene
    target: int
    robot: Robot
    start: Array
    seed: int = 0


@runtime_checkable
class Agent(Protocol):
    """A reaching agent, scripted, planned or learned.

    Attributes:
        name: How it is called in tables.
        env_options: Keywords for `gymnasium.make` that give the environment this agent needs.
    """

    name: str
    env_options: Mapping[str, Any]

    def reset(self, problem: Problem) -> None:
        """Prepare for an episode."""

    def act(self, observation: Any) -> npt.NDArray[np.floating[Any]]:
        """The next action, (joints,) in [-1, 1]."""
