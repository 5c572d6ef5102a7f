"""Your own reward: reach the tomato, and fear stems more than leaves.

python examples/own_reward.py
"""

import gymnasium
import numpy as np

import greenhouse_gym  # noqa: F401 - registers the environments
from greenhouse_gym.envs import CONTACT_GROUPS, DenseReward, Transition

DENSE = DenseReward(progress=2.0)
STEM = CONTACT_GROUPS.index("stem")


def careful(step: Transition) -> dict[str, np.ndarray]:
    """Return the terms of the dense reward and a cost for the contact with a stem, which ends the episode."""
    return {**DENSE(step), "stem": -5.0 * (step.end.contacts[:, STEM] > 0)}


if __name__ == "__main__":
    env = gymnasium.make("TomatoReach-v0", bank="mini", reward=careful)
    env.reset(seed=0)
    _, reward, _, _, info = env.step(env.action_space.sample())
    print(f"{reward:.3f} = {info['reward_terms']}")
