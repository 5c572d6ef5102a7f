"""A vector environment's resets and steps as Stable-Baselines3 reads them, without importing it or PyTorch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs import EnvSettings, GreenhouseVectorEnv, make_vec_env
from greenhouse_gym.envs.observations import Observed

Stepped = tuple[Observed, npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]
"""Observations, rewards, whether episodes ended (and have begun anew), and an info for each simulation."""


TERMS = "episode_terms"
"""Key of the info at an episode's end that holds the sums of the reward's terms over the episode, by name."""


class Steps:
    """The resets and steps of a vector environment with autoreset in the same step.

    Args:
        env: The environment.
    """

    def __init__(self, env: GreenhouseVectorEnv):
        self._env = env
        self._sums: dict[str, npt.NDArray[np.float64]] = {}  # of the episodes that are under way

    def begin(
        self, seeds: Sequence[int | None], options: list[dict[str, Any]]
    ) -> tuple[Observed, list[dict[str, Any]]]:
        """Begin new episodes everywhere: observations (n, size), and an info for each simulation."""
        # Only the first reset, or one after `seed`, has seeds.
        given = None if all(seed is None for seed in seeds) else seeds
        observations, infos = self._env.reset(seed=given, options=options)
        self._sums = {}
        return observations, [_info(infos, i) for i in range(self._env.num_envs)]

    def act(self, actions: Any) -> Stepped:
        """Act once everywhere; episodes that end begin anew.

        Infos are empty except at an episode's end, unless the environment has goals.
        """
        env = self._env
        observations, rewards, terminated, truncated, infos = env.step(actions)
        dones = terminated | truncated
        self._add(infos["reward_terms"])
        telling = env.simulation.observe.has_goals
        single = [_info(infos, i) if telling else {} for i in range(env.num_envs)]
        for i in np.flatnonzero(dones).tolist():
            single[i] = _info(infos["final_info"], i)
            single[i]["terminal_observation"] = infos["final_obs"][i]
            single[i]["TimeLimit.truncated"] = bool(truncated[i])
            single[i][TERMS] = {name: float(sums[i]) for name, sums in self._sums.items()}
        for sums in self._sums.values():
            sums[dones] = 0.0
        return observations, rewards.astype(np.float32), dones, single

    def call(self, method: str, arguments: Sequence[Any], keywords: dict[str, Any]) -> None:
        """Call a method of the environment for what it does."""
        getattr(self._env, method)(*arguments, **keywords)

    def _add(self, terms: dict[str, Any]) -> None:
        for name, values in terms.items():
            if not name.startswith("_"):
                self._sums[name] = self._sums.get(name, 0.0) + values


def steps_of(count: int, settings: EnvSettings, threads: int) -> Steps:
    """Some of the simulations of an environment, kept by a process of a cluster."""
    return Steps(make_vec_env(count, settings, autoreset_mode="SameStep", threads=threads))


def _info(infos: dict[str, Any], i: int) -> dict[str, Any]:
    """One simulation's info out of the vector environment's."""
    result: dict[str, Any] = {}
    for key, values in infos.items():
        if key.startswith(("_", "final_")) or not infos[f"_{key}"][i]:
            continue
        if isinstance(values, dict):
            result[key] = _info(values, i)
        else:
            result[key] = values[i] if values.dtype == object or values.ndim > 1 else values[i].item()
    return result
