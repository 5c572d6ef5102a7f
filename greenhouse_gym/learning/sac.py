"""SAC with hindsight experience replay by Stable-Baselines3 on the goal environment, with settings that learn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from greenhouse_gym.common.extras import needs
from greenhouse_gym.envs.state import STEP_LIMIT
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.learning.sb3 import make_sb3_vec_env
from greenhouse_gym.learning.settings import SacSettings
from greenhouse_gym.learning.training_settings import env_options, require_joint_action

with needs("train"):
    import tensorboard  # noqa: F401  Stable-Baselines3 needs it, but imports it late
    import torch

    from greenhouse_gym.learning.guided_sac import Demonstrator, GuidedSAC
    from greenhouse_gym.learning.sb3_features import policy_for
    from greenhouse_gym.learning.sb3_her import GoalReplayBuffer
    from greenhouse_gym.learning.training_files import load_checkpoint, settings_of
    from greenhouse_gym.learning.training_report import TrainingReport, Validation
    from greenhouse_gym.learning.training_run import (
        as_json,
        check_start,
        learn,
        making_model,
        training_in,
    )


def make_sac(settings: SacSettings) -> Any:
    """Make an untrained Stable-Baselines3 model on its own vector environment.

    Raises:
        InvalidValueError: Too few random steps (hindsight needs a finished episode), guidance without an observed
            waypoint or with actions of the tip, or a negative weight.
    """
    if settings.guided and settings.observation != "goal_roadmap":
        raise InvalidValueError(f'guided needs observation="goal_roadmap", got {settings.observation!r}')
    if settings.guided:
        require_joint_action("guided", settings.action)
    shortest = settings.num_envs * STEP_LIMIT
    if settings.random_steps < shortest:
        raise InvalidValueError(
            f"random_steps must be at least {shortest}, so that an episode of each of the {settings.num_envs} "
            f"simulations ends before learning starts, got {settings.random_steps}"
        )
    env = make_sb3_vec_env(settings.num_envs, threads=settings.threads, seed=settings.seed, **env_options(settings))
    observe = env.get_attr("simulation")[0].observe
    if not observe.has_goals:
        env.close()
        raise InvalidValueError(f"SAC with hindsight needs an observation with goals, got {settings.observation!r}")
    policy, features = policy_for(observe)
    torch.set_num_threads(1)
    with making_model():
        model = GuidedSAC(
            policy,
            env,
            replay_buffer_class=GoalReplayBuffer,
            replay_buffer_kwargs={"n_sampled_goal": settings.hindsight_goals},
            learning_starts=settings.random_steps,
            gradient_steps=settings.updates_per_step,
            batch_size=settings.batch_size,
            learning_rate=settings.learning_rate,
            gamma=settings.discount,
            tau=settings.target_rate,
            ent_coef=f"auto_{settings.entropy_coefficient}",
            buffer_size=settings.memory,
            policy_kwargs={"net_arch": list(settings.hidden), **features},
            seed=settings.seed,
            device="cpu",
        )
    if settings.guided:
        model.demonstrator, model.guide_weight = Demonstrator(observe.layout, settings.seed), settings.guide_weight
    return model


def train_sac(
    settings: SacSettings,
    out: str | Path,
    *,
    resume: bool = False,
    time_limit: float | None = None,
    checkpoint_seconds: float = 60.0,
    on_progress: Callable[[Validation], None] = lambda validation: None,
) -> Path:
    """Train a policy and validate it at intervals.

    ``out`` gets the files of `greenhouse_gym.learning.train_ppo`; ``curve.csv`` has a line per episode length of all
    simulations. A resumed training continues with the weights, the optimizers and the step count of the checkpoint, in
    new episodes and with an empty replay buffer, which its policy fills before it learns further.

    Args:
        settings: The settings.
        out: Folder for the results.
        resume: Continue from the checkpoint in ``out``; otherwise ``out`` must not hold one.
        time_limit: Seconds after which the training stops.
        checkpoint_seconds: Seconds between checkpoints.
        on_progress: Called with each validation.

    Returns:
        The path of the policy's JSON file; `load_sac` makes a model from its folder.

    Raises:
        InvalidValueError: Nothing to resume, a training that would be overwritten, or a checkpoint with other
            settings.
        FileFormatError: The checkpoint is damaged.
        FileWriteError: The folder cannot be written, or another training is at work in it.
        DivergedError: The weights are no longer finite; the last checkpoint with finite ones is kept.
        KeyboardInterrupt: The training was interrupted; its results are written.
    """
    out, described = Path(out), as_json(settings)
    check_start(out, described, resume, time_limit, checkpoint_seconds)
    model = make_sac(settings)
    with training_in(out, model, described, resume):
        if resume:
            model.learning_starts = model.num_timesteps + settings.random_steps
            model.explores = False
        options = {
            **env_options(settings), "num_envs": settings.validation_episodes, "threads": settings.threads
        }  # fmt: skip
        splits = ("train",) if settings.scene is not None else ("train", "validation")
        report = TrainingReport(
            out, described, model, settings.num_envs * STEP_LIMIT, splits, options,
            time_limit, checkpoint_seconds, on_validation=on_progress,
        )  # fmt: skip
        return learn(model, report, resume)


def load_sac(folder: str | Path, num_envs: int | None = None, memory: int | None = None) -> Any:
    """Load the Stable-Baselines3 model of a training's folder, on its own vector environment.

    Args:
        folder: Folder of the training.
        num_envs: Number of simulations; that of the training if None.
        memory: Number of transitions in the replay buffer; that of the training if None.

    Raises:
        FileFormatError: The checkpoint is missing or damaged.
    """
    settings = settings_of(Path(folder), SacSettings)
    settings = replace(settings, num_envs=num_envs or settings.num_envs, memory=memory or settings.memory)
    model = make_sac(settings)
    load_checkpoint(model, Path(folder))
    return model
