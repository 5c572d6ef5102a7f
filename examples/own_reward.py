"""Your own reward: reach the tomato and keep a distance from the leaves.

python examples/own_reward.py
"""

import gymnasium
import numpy as np

import greenhouse_gym  # noqa: F401 - registers the environments
from greenhouse_gym.envs import DenseReward, Transition

DENSE = DenseReward(progress=2.0)


def careful(step: Transition) -> dict[str, np.ndarray]:
    """Return the terms of a dense reward, and a cost for clearances below 5 cm."""
    nearest = step.end.clearance.min(axis=1)
    return {**DENSE(step), "nearness": -2.0 * np.maximum(0.05 - nearest, 0.0)}


if __name__ == "__main__":
    env = gymnasium.make("TomatoReach-v0", bank="mini", reward=careful)
    env.reset(seed=0)
    _, reward, _, _, info = env.step(env.action_space.sample())
    print(f"{reward:.3f} = {info['reward_terms']}")
