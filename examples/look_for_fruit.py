"""Find the ripe fruit of a stand with the wrist camera: the map that views carve, and an agent that plans them."""

from __future__ import annotations

import gymnasium
import numpy as np

import greenhouse_gym  # noqa: F401  registers the environments
from greenhouse_gym.agents import FixedViewsAgent, NextBestViewAgent
from greenhouse_gym.evaluation import compare

if __name__ == "__main__":
    env = gymnasium.make("TomatoLook-v0", bank="mini")
    observation, info = env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(np.array([0, 0, 0, 0, 0, 0, 1]))
    print(f"found {info['found']} of {info['ripe']}, {np.mean(observation['map'] > 0):.0%} of the map is known")
    agents = [NextBestViewAgent(max_views=5), FixedViewsAgent(max_views=5)]
    for found in compare(agents, "train", episodes=2, bank="mini", task="look"):
        print(found.agent, [round(record.measures["fraction_5"], 2) for record in found.records])
