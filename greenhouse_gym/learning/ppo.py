"""PPO by Stable-Baselines3 on the native vector environment, with settings that are known to learn."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.envs.episodes import EpisodeSampler
from greenhouse_gym.envs.settings import check_whole
from greenhouse_gym.errors import require_choice, require_seed
from greenhouse_gym.learning.folders import check_folder
from greenhouse_gym.learning.sb3 import make_sb3_vec_env
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import SceneBank

with needs("train"):
    import tensorboard  # noqa: F401  what Stable-Baselines3 writes its curves with, and does not ask for at once
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import configure

    from greenhouse_gym.learning.checkpoints import NAME as CHECKPOINT
    from greenhouse_gym.learning.checkpoints import load_checkpoint, read_notes
    from greenhouse_gym.learning.policies import save_policy
    from greenhouse_gym.learning.ppo_report import JUDGED_SPLIT, CriticFirst, Report
    from greenhouse_gym.learning.sb3_features import ScaledObservation

ACTIVATIONS = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}
"""Activations by name."""


@dataclass(frozen=True)
class PpoSettings:
    """Settings of a training.

    Attributes:
        bank: Name or folder of the scene bank.
        split: Split to train on.
        robot: The arm.
        observation: "state", "clearance_rays" or "waypoint".
        reward: "path", "dense" or "sparse".
        difficulty: Difficulties of the targets.
        total_steps: Steps of all simulations together.
        num_envs: Simulations.
        rollout_steps: Steps of each simulation between updates.
        batch_size: Samples per gradient step.
        epochs: Passes over a rollout.
        learning_rate: Learning rate at the start; it falls linearly to zero.
        discount: Discount of future rewards, per step.
        gae_lambda: Lambda of the generalized advantage estimate.
        clip_range: How far from 1 the ratio of probabilities may go.
        log_std: Initial logarithm of the action noise.
        hidden: Sizes of the hidden layers, of actor and critic each.
        activation: What stands between the layers, "tanh" or "relu".
        critic_rollouts: Rollouts at the beginning from which the critic alone learns: a policy that can do something
            already is not to be judged by a critic that knows nothing.
        validation_steps: Steps between judgments of the policy without its noise on rows that are not trained on; with
            0 there are none.
        validation_episodes: Episodes of each judgment, always the same ones.
        seed: Seed of scenes, weights and noise.
        threads: Threads of the simulation; 0 uses all cores. The network has one: with more, its many small products
            wait for each other, on a busy machine most of the time.
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
    make_env: Callable[..., Any] = make_sb3_vec_env,
    on_line: Callable[[Mapping[str, float]], None] = lambda line: None,
) -> Path:
    """Train a policy.

    ``out`` gets ``settings.json``, ``curve.csv`` (one line per rollout), ``validation.csv`` (one per judgment),
    ``tensorboard`` (both, with the reward's terms and the losses), ``checkpoint.safetensors`` now and then and at the
    end, also when interrupted, and ``policy.json`` with ``policy.safetensors`` beside it. A resumed training goes on
    with the weights, the optimizer and the step count of the checkpoint, in new episodes.

    Args:
        settings: The settings.
        out: Folder for the results.
        resume: Go on from the checkpoint in ``out``; otherwise ``out`` must not hold one.
        time_limit: Stop after this many seconds, as if interrupted.
        checkpoint_seconds: Time between checkpoints.
        prepare: Gets the untrained model of a training that is not resumed, to put something into it.
        make_env: Makes the environment, of the same arguments: another one, such as
            `greenhouse_gym.learning.sb3_ray.make_sb3_ray_vec_env`, steps the simulations elsewhere.
        on_line: Told each new line of ``curve.csv`` when its rollout is done; a `KeyboardInterrupt` that it raises
            interrupts the training there.

    Returns:
        The path of the policy's JSON file.

    Raises:
        InvalidValueError: There is nothing to resume, or something that would be overwritten, or the checkpoint was
            made with other settings; or the policy cannot be judged as the settings want it.
        FileFormatError: The checkpoint is damaged.
        KeyboardInterrupt: The training was interrupted; what there was is written.
    """
    require_seed(settings.seed)
    _check_judging(settings)
    out = Path(out)
    described = json.loads(json.dumps(asdict(settings)))
    check_folder(out / CHECKPOINT, lambda: read_notes(out)["settings"], described, "total_steps", resume)
    torch.set_num_threads(1)
    env = make_env(
        settings.num_envs, bank=settings.bank, split=settings.split, robot=settings.robot,
        observation=settings.observation, reward=settings.reward, difficulty=settings.difficulty,
        threads=settings.threads, seed=settings.seed,
    )  # fmt: skip
    model = make_ppo(settings, env)
    model.set_logger(configure(str(out / "tensorboard"), ["tensorboard"]))
    if resume:
        load_checkpoint(model, out)
        env.seed(settings.seed + model.num_timesteps)
    elif prepare is not None:
        prepare(model)
    notes = {"settings": described, "bank_sha256": SceneBank.open(settings.bank).sha256}
    write_atomically(out / "settings.json", json.dumps(described, indent=1) + "\n")
    report = Report(out, settings, model, time_limit, checkpoint_seconds, on_line)
    try:
        if model.num_timesteps < settings.total_steps:
            remaining = settings.total_steps - model.num_timesteps
            callbacks = [report, CriticFirst(0 if model.num_timesteps else settings.critic_rollouts)]
            model.learn(remaining, callback=callbacks, reset_num_timesteps=not resume)
    except KeyboardInterrupt:
        report.say(f"interrupted after {model.num_timesteps} steps; resume goes on from here")
        save_policy(model, out / "policy", notes)
        raise
    finally:
        report.finish()
        env.close()
    return save_policy(model, out / "policy", notes)


def _check_judging(settings: PpoSettings) -> None:
    """Refuse judgments that would fail in the middle of the training."""
    check_whole("validation_episodes", settings.validation_episodes, 1)
    if check_whole("validation_steps", settings.validation_steps, 0):
        sampler = EpisodeSampler(settings.bank, JUDGED_SPLIT, get_robot(settings.robot), settings.difficulty)
        sampler.draw(np.random.default_rng(0))


def make_ppo(settings: PpoSettings, env: Any) -> Any:
    """The Stable-Baselines3 model, untrained, on an environment of `make_sb3_vec_env`."""
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
