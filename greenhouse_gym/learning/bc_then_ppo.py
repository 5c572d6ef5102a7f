"""Imitation of a teacher that knows the scenes, then PPO: minutes instead of hours of training."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from greenhouse_gym.common.files import exclusive
from greenhouse_gym.envs import make_vec_env
from greenhouse_gym.learning.imitation import follow_waypoint, imitate
from greenhouse_gym.learning.ppo import train_ppo
from greenhouse_gym.learning.settings import BcThenPpoSettings
from greenhouse_gym.learning.training_run import as_json, check_start
from greenhouse_gym.learning.variation import varied_bank
from greenhouse_gym.scene import SceneBank


def train_bc_then_ppo(
    settings: BcThenPpoSettings,
    out: str | Path,
    *,
    resume: bool = False,
    on_progress: Callable[[int, dict[str, float]], None] = lambda steps, figures: None,
) -> Path:
    """Train a policy; ``out`` gets the files of `greenhouse_gym.learning.train_ppo` and the varied scenes.

    Args:
        settings: The settings.
        out: Folder for the results.
        resume: Continue from the checkpoint in ``out``, with PPO.
        on_progress: Called with the steps and figures of the imitation after each round.

    Returns:
        The path of the policy's JSON file.
    """
    out, ppo = Path(out), settings.ppo
    if settings.variations:
        plain, ppo = SceneBank.open(ppo.bank), replace(ppo, bank=str((out / "bank").resolve()))
        check_start(out, as_json(ppo), resume)
        with exclusive(out):
            varied_bank(plain, out / "bank", settings.variations, ppo.seed)

    def teach(model: Any) -> None:
        options = {
            name: getattr(ppo, name)
            for name in (
                "bank", "split", "robot", "observation", "action", "task", "difficulty", "scene", "target", "threads"
            )
        }  # fmt: skip
        if settings.from_rule:
            follow_waypoint(model.policy)
        if not settings.imitation.steps:
            return
        env = make_vec_env(settings.imitation.num_envs, autoreset_mode="SameStep", **options)
        with closing(env):
            imitate(model.policy, env, settings.imitation, ppo.seed, on_progress)

    return train_ppo(ppo, out, resume=resume, prepare=teach)
