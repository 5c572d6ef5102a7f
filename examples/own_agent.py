"""Your own agent: `greenhouse-gym compare examples/own_agent.py:ReachForIt random`."""

import numpy as np

from greenhouse_gym.agents import Problem


class ReachForIt:
    """Turn the base towards the tomato and lean forward, without regard to obstacles."""

    name = "reach for it"
    env_options = {"robot": "ur5e", "observation": "state", "action": "joint"}

    def reset(self, problem: Problem) -> None:
        """Prepare for an episode; the problem holds the scene, target, arm, start and seed."""

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the next action in [-1, 1]; `help(GreenhouseEnv)` lists the entries of the observation."""
        turn = np.arctan2(observation[28], observation[27]) - observation[0]
        return np.clip([5 * turn, 0.5, 0.5, 0, 0, 0], -1, 1)
