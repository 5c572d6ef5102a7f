"""What an environment is made of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from greenhouse_gym.envs.episodes import Difficulty
from greenhouse_gym.envs.observations import DepthObservation, PointsObservation
from greenhouse_gym.envs.randomization import NO_RANDOMIZATION, Randomization
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import SceneBank


@dataclass(frozen=True)
class EnvSettings:
    """What an environment is made of; `TomatoReachEnv` says what each means."""

    bank: str | Path | SceneBank = "default"
    split: str = "train"
    robot: str | Path | Robot = "ur5e"
    observation: str | DepthObservation | PointsObservation = "state"
    action: str = "joint"
    reward: str = "dense"
    difficulty: Difficulty = ("easy", "medium", "hard")
    physics: str = "reconstruction"
    randomization: Randomization = NO_RANDOMIZATION
    capacity: int | None = None
