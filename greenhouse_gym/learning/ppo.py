"""PPO by Stable-Baselines3 on the native vector environment, with settings that are known to learn."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.common.extras import needs
from greenhouse_gym.envs.episodes import EpisodeSampler
from greenhouse_gym.errors import check_whole, require_choice, require_seed
from greenhouse_gym.learning.sb3 import make_sb3_vec_env
from greenhouse_gym.robots import get_robot

with needs("train"):
    import tensorboard  # noqa: F401  Stable-Baselines3 needs it, but imports it late
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback

    from greenhouse_gym.learning.sb3_features import ScaledObservation
    from greenhouse_gym.learning.training_run import TrainingReport, as_json, check_start, learn, set_up

ACTIVATIONS = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}
"""Activation functions by name."""

VALIDATION_SPLIT = "validation"
"""Split whose rows are not trained on."""


@dataclass(frozen=True)
class PpoSettings:
    """Settings of a training by PPO.

    Attributes:
        bank: Name or folder of the scene bank.
        split: Split to train on.
        robot: The arm.
        observation: "state", "clearance_rays" or "waypoint".
        reward: "path", "dense" or "sparse".
        difficulty: Difficulties of the targets.
        total_steps: Steps of all simulations together.
        num_envs: Number of simulations.
        rollout_steps: Steps of each simulation between updates.
        batch_size: Samples per gradient step.
        epochs: Passes over a rollout.
        learning_rate: Learning rate at the start; it falls linearly to zero.
        discount: Discount of future rewards, per step.
        gae_lambda: Lambda of the generalized advantage estimate.
        clip_range: Largest deviation of the probability ratio from 1.
        log_std: Initial logarithm of the standard deviation of the action noise.
        hidden: Sizes of the hidden layers of actor and critic.
        activation: Activation function between the layers, "tanh" or "relu".
        critic_rollouts: Rollouts at the beginning that train the critic alone, so that an untrained critic does not
            spoil a policy that is already good.
        validation_steps: Steps between validations: episodes on rows not trained on, without the policy's noise; 0 for
            none.
        validation_episodes: Episodes of each validation, the same ones every time.
        seed: Seed of scenes, weights and noise.
        threads: Threads of the simulation; 0 uses all cores. The network has one: on a busy machine, more threads
            mostly wait for each other.
    """

    bank: str = "default"
    split: str = "train"
    robot: str = "ur5e"
    observation: str = "waypoint"
    reward: str = "path"
    difficulty: tuple[str, ...] = ("easy", "medium", "hard")
    total_steps: int = 2_000_000
    num_envs: int = 128
    rollout_steps: int = 64
    batch_size: int = 4096
    epochs: int = 8
    learning_rate: float = 5e-4
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    log_std: float = -1.5
    hidden: tuple[int, ...] = (256, 256)
    activation: str = "relu"
    critic_rollouts: int = 0
    validation_steps: int = 0
    validation_episodes: int = 100
    seed: int = 0
    threads: int = 0


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
    and when interrupted, and ``policy.json`` with ``policy.safetensors``. A resumed training continues with the
    weights, the optimizer and the step count of the checkpoint, in new episodes.

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
        KeyboardInterrupt: The training was interrupted; its results are written.
    """
    require_seed(settings.seed)
    _check_validation(settings)
    out, described = Path(out), as_json(settings)
    check_start(out, described, resume)
    torch.set_num_threads(1)
    env = make_sb3_vec_env(
        settings.num_envs, bank=settings.bank, split=settings.split, robot=settings.robot,
        observation=settings.observation, reward=settings.reward, difficulty=settings.difficulty,
        threads=settings.threads, seed=settings.seed,
    )  # fmt: skip
    model = make_ppo(settings, env)
    set_up(model, out, described, resume)
    if not resume and prepare is not None:
        prepare(model)
    options = {
        "num_envs": min(settings.num_envs, settings.validation_episodes),
        **{name: getattr(settings, name) for name in ("bank", "robot", "difficulty", "threads")},
    }
    report = TrainingReport(
        out, described, model, settings.num_envs * settings.rollout_steps, (VALIDATION_SPLIT,), options, time_limit,
        checkpoint_seconds, on_progress,
    )  # fmt: skip
    return learn(model, report, resume, [CriticFirst(0 if model.num_timesteps else settings.critic_rollouts)])


def _check_validation(settings: PpoSettings) -> None:
    """Raise an error for a validation that would fail in the middle of the training."""
    check_whole("validation_episodes", settings.validation_episodes, 1)
    if check_whole("validation_steps", settings.validation_steps, 0):
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
    """Make an untrained Stable-Baselines3 model on an environment of `make_sb3_vec_env`."""
    layout = env.get_attr("simulation")[0].observe.layout
    return PPO(
        "MlpPolicy",
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
            "activation_fn": ACTIVATIONS[require_choice("activation", settings.activation, ACTIVATIONS)],
            "log_std_init": settings.log_std,
            "features_extractor_class": ScaledObservation,
            "features_extractor_kwargs": {"layout": layout},
        },
        seed=settings.seed,
        device="cpu",
    )
