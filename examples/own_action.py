"""Your own kind of action: two numbers move the shoulder and the elbow, and the wrist keeps the tool level.

python examples/own_action.py
"""

import gymnasium
import numpy as np
from gymnasium import spaces

import greenhouse_gym  # noqa: F401 - registers the environments
from greenhouse_gym.envs import State, ToolMotion


class TwoJoints:
    """Moves shoulder and elbow of the UR5e by up to 0.08 rad per step; the first wrist joint compensates."""

    space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __call__(self, action: np.ndarray, state: State, motion: ToolMotion) -> np.ndarray:
        """Return changes (n, 6) of the commands, radians."""
        change = np.zeros_like(state.joints)
        change[:, 1:3] = 0.08 * action
        change[:, 3] = -change[:, 1] - change[:, 2]
        return change


if __name__ == "__main__":
    env = gymnasium.make("TomatoReach-v0", bank="mini", action=TwoJoints())
    env.reset(seed=0)
    print(env.step(np.array([1.0, -0.5], dtype=np.float32))[4]["distance"])
