"""An agent that never moves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from greenhouse_gym.agents import Problem

STILL = "still_agent:StillAgent"  # as commands take it


class StillAgent:
    name = "still"
    env_options: Mapping[str, Any] = {}

    def __init__(self) -> None:
        self._action = np.zeros(0, dtype=np.float32)

    def reset(self, problem: Problem) -> None:
        self._action = np.zeros(problem.action_space.shape, dtype=np.float32)

    def act(self, observation: Any) -> np.ndarray:
        return self._action
