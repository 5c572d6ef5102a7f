"""A task with several targets: touch three tomatoes one after the other, and brush leaves as little as possible.

A task is a class with functions of arrays over n simulations, so it runs in single and vector environments, and any
learner or agent can use it. Pass the class as ``task=``, or ``"three_tomatoes.py:ThreeTomatoes"``, or register it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from greenhouse_gym.agents import RandomAgent, StraightLineAgent
from greenhouse_gym.envs import Episode, EpisodeSampler, Feature, Outcome, State, Task
from greenhouse_gym.evaluation import compare, comparison_table


class ThreeTomatoes(Task):
    """Bring the tool to within 3 cm of three tomatoes in turn; leaves give way at a cost."""

    ends_on = ("fruit", "stem", "fixture", "self")
    costs = {"leaf": -0.02}
    memory = {"touched": 0}
    features = {
        **Task.features,
        "remaining": Feature(lambda state: state.remaining[:, None], lambda robot: (np.zeros(1), np.full(1, 3.0))),
    }

    def sample(self, sampler: EpisodeSampler, rng: np.random.Generator, options: Mapping[str, Any] | None) -> Episode:
        """Draw a scene with a target, and two more of its tomatoes."""
        episode = sampler.draw(rng, options)
        others = [k for k in sampler.targets(episode.scene) if k != episode.targets[0]]
        more = rng.permutation(others)[:2].tolist()
        return replace(episode, targets=(*episode.targets, *more))

    def evaluate(self, state: State) -> Outcome:
        """Go on to the next tomato when one is touched; the last one is the success."""
        distance = np.linalg.norm(state.goal - state.grasp, axis=1)
        reached = (distance < 0.03) & ~state.collided
        count = state.memory["touched"] + reached
        return Outcome(distance, reached & (state.remaining == 1), state.collided, reached, {"touched": count})


if __name__ == "__main__":
    gymnasium.register(
        id="ThreeTomatoes-v0",
        entry_point="greenhouse_gym.envs:GreenhouseEnv",
        vector_entry_point="greenhouse_gym.envs:GreenhouseVectorEnv",
        kwargs={"task": ThreeTomatoes, "step_limit": 400},
    )
    env = gymnasium.make_vec("ThreeTomatoes-v0", num_envs=4, bank="mini")
    observations, infos = env.reset(seed=0)
    print(observations.shape, infos["touched"])
    agents = [RandomAgent(), StraightLineAgent()]
    print(comparison_table(compare(agents, "test", episodes=3, bank="mini", task=ThreeTomatoes)))
