"""Factory of environments: the one place where agents, evaluation and learning create them."""

from __future__ import annotations

from typing import Any

from greenhouse_gym.envs.environment import GreenhouseEnv
from greenhouse_gym.envs.settings import EnvSettings
from greenhouse_gym.envs.vector import GreenhouseVectorEnv


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
