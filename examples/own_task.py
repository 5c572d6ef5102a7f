"""Your own task: look at a tomato along the tool from a distance of 30 cm, as for an inspection.

A task is a class with elementwise functions over n simulations. Pass it as ``task=``, as ``"own_task.py:LookAtTomato"``
on the command line, or register an environment for it.
"""

from __future__ import annotations

import gymnasium
import numpy as np

from greenhouse_gym.agents import RandomAgent, StraightLineAgent
from greenhouse_gym.envs import Outcome, State, Task
from greenhouse_gym.evaluation import compare, comparison_table


class LookAtTomato(Task):
    """Bring the tool to 30 cm from a tomato, pointing at it within 15 degrees, without touching anything."""

    def evaluate(self, state: State) -> Outcome:
        """Return the distance to the viewing position, success and failure of n simulations."""
        view = state.goal - state.tip
        away = np.linalg.norm(view, axis=1)
        facing = (view * state.axis).sum(axis=1) > np.cos(np.radians(15)) * away
        distance = np.abs(away - 0.3)
        return Outcome(distance, (distance < 0.02) & facing & ~state.collided, state.collided)


if __name__ == "__main__":
    gymnasium.register(
        id="LookAtTomato-v0",
        entry_point="greenhouse_gym.envs:GreenhouseEnv",
        vector_entry_point="greenhouse_gym.envs:GreenhouseVectorEnv",
        kwargs={"task": LookAtTomato},
    )
    print(gymnasium.make("LookAtTomato-v0", bank="mini").reset(seed=0)[1]["distance"])
    print(gymnasium.make_vec("LookAtTomato-v0", num_envs=4, bank="mini").reset(seed=0)[1]["distance"])
    agents = [RandomAgent(), StraightLineAgent()]
    print(comparison_table(compare(agents, episodes=8, bank="mini", task=LookAtTomato)))
