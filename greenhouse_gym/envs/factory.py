"""Factory of environments: the one place where agents, evaluation and learning create them."""

from __future__ import annotations

from typing import Any

from gymnasium.vector import VectorEnv

from greenhouse_gym.envs.environment import GreenhouseEnv
from greenhouse_gym.envs.settings import EnvSettings
from greenhouse_gym.envs.vector import GreenhouseVectorEnv
from greenhouse_gym.errors import require_choice

BACKENDS = ("mujoco", "warp")
"""Backends of vector environments."""


def make_vec(num_envs: int = 1, *, backend: str = "mujoco", **keywords: Any) -> VectorEnv[Any, Any, Any]:
    """Create a vector environment, as ``gymnasium.make_vec`` does.

    Args:
        num_envs: Number of simulations.
        backend: "mujoco" for `GreenhouseVectorEnv`, or "warp" for `greenhouse_gym.envs.warp.WarpVectorEnv`.
        **keywords: Keywords of that class.

    Raises:
        UnknownNameError: There is no such backend.
        MissingDependencyError: Warp is not installed.
    """
    if require_choice("backend", backend, BACKENDS) == "mujoco":
        return GreenhouseVectorEnv(num_envs, **keywords)
    from greenhouse_gym.envs.warp import WarpVectorEnv  # loads Warp

    return WarpVectorEnv(num_envs, **keywords)


def make_env(settings: EnvSettings | None = None, *, render_mode: str | None = None, **fields: Any) -> GreenhouseEnv:
    """Create a single environment; see `GreenhouseEnv` for the arguments."""
    return GreenhouseEnv(settings, render_mode=render_mode, **fields)


def make_vec_env(
    num_envs: int,
    settings: EnvSettings | None = None,
    *,
    render_mode: str | None = None,
    autoreset_mode: str = "NextStep",
    threads: int = 0,
    **fields: Any,
) -> GreenhouseVectorEnv:
    """Create a vector environment; see `GreenhouseVectorEnv` for the arguments."""
    return GreenhouseVectorEnv(
        num_envs, settings, render_mode=render_mode, autoreset_mode=autoreset_mode, threads=threads, **fields
    )
