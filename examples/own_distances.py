"""Your own observation of obstacles: their distances on a grid of points ahead of the tool.

python examples/own_distances.py
"""

import gymnasium
import numpy as np
from gymnasium import spaces

import greenhouse_gym  # noqa: F401 - registers the environments
from greenhouse_gym.envs import State

GRID = np.stack(np.meshgrid([0.0, 0.08, 0.16], [-0.08, 0.0, 0.08], [-0.08, 0.0, 0.08]), -1).reshape(-1, 3)


class Ahead:
    """Offset from the tip to the target, and distances of obstacles around the tip, metres."""

    space = spaces.Box(-5.0, 5.0, (3 + len(GRID),), np.float32)

    def __call__(self, state: State) -> np.ndarray:
        """Return one row for each of n simulations."""
        distances, _ = state.distances_at(state.tip[:, None] + GRID)
        return np.clip(np.hstack([state.target - state.tip, distances]), -5.0, 5.0).astype(np.float32)


if __name__ == "__main__":
    env = gymnasium.make("TomatoReach-v0", bank="mini", observation=Ahead())
    print(env.reset(seed=0)[0])
