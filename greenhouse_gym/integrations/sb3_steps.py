"""A vector environment's resets and steps as Stable-Baselines3 reads them, without importing it or PyTorch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs import EnvSettings, TomatoReachVectorEnv
from greenhouse_gym.envs.observations import Observed

Stepped = tuple[Observed, npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]
"""Observations, rewards, whether episodes ended (and have begun anew), and an info for each simulation."""


def begin(
    env: TomatoReachVectorEnv, seeds: Sequence[int | None], options: list[dict[str, Any]]
) -> tuple[Observed, list[dict[str, Any]]]:
    """Begin new episodes everywhere: observations (n, size), and an info for each simulation."""
    # Only the first reset, or one after `seed`, has seeds.
    given = None if all(seed is None for seed in seeds) else seeds
    observations, infos = env.reset(seed=given, options=options)
    return observations, [_info(infos, i) for i in range(env.num_envs)]


def act(env: TomatoReachVectorEnv, actions: Any) -> Stepped:
    """Act once everywhere; episodes that end begin anew.

    Infos are empty except at an episode's end, unless the environment has goals.
    """
    observations, rewards, terminated, truncated, infos = env.step(actions)
    dones = terminated | truncated
    telling = env.simulation.observe.has_goals
    single = [_info(infos, i) if telling else {} for i in range(env.num_envs)]
    for i in np.flatnonzero(dones).tolist():
        single[i] = _info(infos["final_info"], i)
        single[i]["terminal_observation"] = infos["final_obs"][i]
        single[i]["TimeLimit.truncated"] = bool(truncated[i])
    return observations, rewards.astype(np.float32), dones, single


class Part:
    """Some of the simulations of an environment, kept by a process of a cluster."""

    def __init__(self, count: int, settings: EnvSettings, threads: int):
        self._env = TomatoReachVectorEnv(count, settings, autoreset_mode="SameStep", threads=threads)

    def begin(
        self, seeds: Sequence[int | None], options: list[dict[str, Any]]
    ) -> tuple[Observed, list[dict[str, Any]]]:
        """Begin new episodes in these simulations."""
        return begin(self._env, seeds, options)

    def act(self, actions: npt.NDArray[np.float32]) -> Stepped:
        """Act once in these simulations."""
        return act(self._env, actions)

    def call(self, method: str, arguments: Sequence[Any], keywords: dict[str, Any]) -> None:
        """Call a method of the environment for what it does."""
        getattr(self._env, method)(*arguments, **keywords)


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
