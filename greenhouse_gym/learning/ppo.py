"""PPO by Stable-Baselines3 on the native vector environment, with settings that are known to learn."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.common.extras import needs
from greenhouse_gym.envs.episodes import EpisodeSampler
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.learning.sb3 import make_sb3_vec_env
from greenhouse_gym.learning.settings import PpoSettings
from greenhouse_gym.learning.training_settings import env_options, physics_of
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import SceneBank

with needs("train"):
    import tensorboard  # noqa: F401  Stable-Baselines3 needs it, but imports it late
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback

    from greenhouse_gym.learning.sb3_features import policy_for
    from greenhouse_gym.learning.training_files import load_checkpoint, settings_of
    from greenhouse_gym.learning.training_report import TrainingReport
    from greenhouse_gym.learning.training_run import as_json, check_start, learn, making_model, training_in

_ACTIVATIONS = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}

VALIDATION_SPLIT = "validation"
"""Split whose rows are not trained on."""


def train_ppo(
    settings: PpoSettings,
    out: str | Path,
    *,
    resume: bool = False,
    time_limit: float | None = None,
    checkpoint_seconds: float = 60.0,
    prepare: Callable[[Any], None] | None = None,
    on_progress: Callable[[Mapping[str, float]], None] = lambda line: None,
) -> Path:
    """Train a policy.

    ``out`` gets ``settings.json``, ``curve.csv`` (one line per rollout), ``validation.csv`` (one per validation),
    ``tensorboard`` (both, with the reward's terms and the losses), ``checkpoint.safetensors`` at intervals, at the end
    and when interrupted, and ``policy.json`` with ``policy.safetensors``. A training that is killed and resumed ends in
    the same policy as one that is left alone; after an interrupt it continues where it stood, in new episodes.

    Args:
        settings: The settings.
        out: Folder for the results.
        resume: Continue from the checkpoint in ``out``; otherwise ``out`` must not hold one.
        time_limit: Seconds after which the training stops.
        checkpoint_seconds: Seconds between checkpoints.
        prepare: Called with the untrained model of a new training, for example to load weights.
        on_progress: Called with each new line of ``curve.csv``; a `KeyboardInterrupt` that it raises interrupts the
            training.

    Returns:
        The path of the policy's JSON file.

    Raises:
        InvalidValueError: Nothing to resume, a training that would be overwritten, a checkpoint with other settings,
            or no episodes for the validation.
        FileFormatError: The checkpoint is damaged.
        FileWriteError: The folder cannot be written, or another training is at work in it.
        DivergedError: The weights are no longer finite; the last checkpoint with finite ones is kept.
        KeyboardInterrupt: The training was interrupted; its results are written.
    """
    if settings.total_steps < (1 if prepare is None else 0):
        raise InvalidValueError(f"total_steps must be a whole number from 1 up, got {settings.total_steps}")
    _check_validation(settings)
    out, described = Path(out), as_json(settings)
    check_start(out, described, resume, time_limit, checkpoint_seconds)
    world = env_options(settings)
    if settings.sources:
        world["bank"] = SceneBank.open(settings.bank).select(split=settings.split, source=settings.sources)
    env = make_sb3_vec_env(
        settings.num_envs, split=settings.split, threads=settings.threads, seed=settings.seed, **world
    )
    model = make_ppo(settings, env)
    with training_in(out, model, described, resume):
        if not resume and prepare is not None:
            prepare(model)
        options = {
            "num_envs": min(settings.num_envs, settings.validation_episodes),
            **{name: getattr(settings, name) for name in ("bank", "robot", "difficulty", "threads", "task", "plants")},
            **physics_of(settings),
        }
        report = TrainingReport(
            out, described, model, settings.num_envs * settings.rollout_steps, (VALIDATION_SPLIT,), options,
            time_limit, checkpoint_seconds, settings.num_envs * settings.restart_steps, on_progress,
        )  # fmt: skip
        return learn(
            model, report, resume, [CriticFirst(settings.critic_rollouts - model._n_updates // settings.epochs)]
        )


def _check_validation(settings: PpoSettings) -> None:
    """Raise an error for a validation that would fail in the middle of the training."""
    if settings.validation_steps:
        sampler = EpisodeSampler(settings.bank, VALIDATION_SPLIT, get_robot(settings.robot), settings.difficulty)
        sampler.draw(np.random.default_rng(0))


class CriticFirst(BaseCallback):  # type: ignore[misc]
    """Train the critic alone during the first rollouts.

    Args:
        rollouts: Number of these rollouts.
    """

    def __init__(self, rollouts: int):
        super().__init__()
        self.left = rollouts

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        for name, parameter in self.model.policy.named_parameters():
            if "value" not in name:
                parameter.requires_grad = self.left <= 0
        self.left -= 1


def make_ppo(settings: PpoSettings, env: Any) -> Any:
    """Make an untrained Stable-Baselines3 model on an environment of `make_sb3_vec_env`.

    Raises:
        InvalidValueError: There is no such network, for example because images are too small for its convolutions.
    """
    policy, features = policy_for(env.get_attr("simulation")[0].observe)
    torch.set_num_threads(1)
    with making_model():
        return PPO(
            policy,
            env,
            n_steps=settings.rollout_steps,
            batch_size=settings.batch_size,
            n_epochs=settings.epochs,
            learning_rate=lambda remaining: settings.learning_rate * remaining,
            gamma=settings.discount,
            gae_lambda=settings.gae_lambda,
            clip_range=settings.clip_range,
            policy_kwargs={
                "net_arch": list(settings.hidden),
                "activation_fn": _ACTIVATIONS[settings.activation],
                "log_std_init": settings.log_std,
                **features,
            },
            seed=settings.seed,
            device="cpu",
        )


def load_ppo(folder: str | Path, num_envs: int | None = None) -> Any:
    """Load the Stable-Baselines3 model of a training's folder, on its own vector environment.

    Args:
        folder: Folder of the training.
        num_envs: Number of simulations; that of the training if None.

    Raises:
        FileFormatError: The checkpoint is missing or damaged.
    """
    settings = settings_of(Path(folder), PpoSettings)
    if num_envs is not None:
        settings = replace(settings, num_envs=num_envs, batch_size=max(2, num_envs * settings.rollout_steps))
    env = make_sb3_vec_env(
        settings.num_envs, split=settings.split, threads=settings.threads, seed=settings.seed, **env_options(settings)
    )
    model = make_ppo(settings, env)
    load_checkpoint(model, Path(folder))
    return model
