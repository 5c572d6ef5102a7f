"""Your own observation: the offset to the target and the clearances of the arm, and nothing else.

python examples/own_observation.py
"""

import gymnasium
import numpy as np
from gymnasium import spaces

import greenhouse_gym  # noqa: F401 - registers the environments
from greenhouse_gym.envs import State
from greenhouse_gym.robots import Robot


class Feelers:
    """Offset to the target and clearances (metres)."""

    def __init__(self, robot: Robot):
        self.space = spaces.Box(-5.0, 5.0, (3 + len(robot.probes),), np.float32)

    def __call__(self, state: State) -> np.ndarray:
        """Return one row for each of n simulations."""
        offset = state.target - state.grasp
        return np.clip(np.hstack([offset, state.clearance]), -5.0, 5.0).astype(np.float32)


if __name__ == "__main__":
    env = gymnasium.make("TomatoReach-v0", bank="mini", observation=Feelers)
    print(env.reset(seed=0)[0])
