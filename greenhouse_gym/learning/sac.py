"""SAC with hindsight experience replay by Stable-Baselines3 on the goal environment, with settings that learn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.setting_checks import Count, Fraction, PositiveCount
from greenhouse_gym.envs import EnvSettings
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.learning.sb3 import make_sb3_vec_env
from greenhouse_gym.learning.training_settings import (
    Choice,
    Layers,
    Rate,
    SceneChoice,
    Seed,
    Simulations,
    Threads,
    check_settings,
    env_options,
)

with needs("train"):
    import tensorboard  # noqa: F401  Stable-Baselines3 needs it, but imports it late
    import torch

    from greenhouse_gym.learning.guided_sac import Demonstrator, GuidedSAC
    from greenhouse_gym.learning.sb3_features import policy_for
    from greenhouse_gym.learning.sb3_her import GoalReplayBuffer
    from greenhouse_gym.learning.training_files import load_checkpoint, settings_of
    from greenhouse_gym.learning.training_run import (
        TrainingReport,
        Validation,
        as_json,
        check_start,
        learn,
        making_model,
        training_in,
    )


@dataclass(frozen=True)
class SacSettings:
    """Settings of a training by SAC.

    Attributes:
        bank: Name or folder of the scene bank; its training split is trained on.
        robot: The arm.
        difficulty: Difficulties of the targets.
        observation: "goal", or "goal_roadmap", which adds the next waypoint of a collision-free path, or your own with
            goals.
        action: Action of the environment, by name or your own.
        reward: "dense", "sparse" or your own. With the sparse one a collision costs what a success pays, so arms that
            still collide often learn to keep away from the plants; it learned little.
        task: Task of the environment, by name or your own; one with goals.
        scene: Name of the only scene to train on; all scenes of the split if None.
        target: Index of its only tomato to train on; needs a scene.
        num_envs: Number of simulations.
        updates_per_step: Gradient steps per step of all simulations.
        batch_size: Transitions per gradient step.
        learning_rate: Learning rate of actor, critics and entropy coefficient.
        discount: Discount of future rewards, per step.
        target_rate: Fraction by which the target critics move towards the critics per gradient step.
        entropy_coefficient: Initial value; it adapts. With a much higher one, acting at random pays more than a
            success, which ends the episode.
        hindsight_goals: Transitions with a goal in hindsight per real one.
        memory: Number of transitions in the replay buffer.
        random_steps: Steps with random actions before the first gradient step; at least one episode per simulation.
        guided: True to follow the waypoint in these steps instead, exactly in the first simulation and with most noise
            in the last, and to constrain the actor towards that rule.
        guide_weight: Weight of that constraint against the critics; see `GuidedSAC`.
        total_steps: Steps of all simulations together.
        validation_steps: Steps between validations on rows that are trained on and on rows that are not, without the
            policy's noise.
        validation_episodes: Episodes of each validation and split, the same ones every time.
        hidden: Sizes of the hidden layers of actor and critics.
        seed: Seed of scenes, weights and noise.
        threads: Threads of the simulation; 0 uses all cores. The network has one: on a busy machine, more threads
            mostly wait for each other.
    """

    bank: str = "mini"
    robot: str = "ur5e"
    difficulty: str | tuple[str, ...] | dict[str, float] = ("easy",)
    observation: Choice = "goal"
    action: Choice = "joint"
    reward: Choice = "dense"
    task: Choice = "reach"
    scene: SceneChoice = None
    target: int | None = None
    num_envs: Simulations = 32
    updates_per_step: PositiveCount = 8
    batch_size: PositiveCount = 256
    learning_rate: Rate = 1e-3
    discount: Fraction = 0.97
    target_rate: Fraction = 0.02
    entropy_coefficient: Rate = 0.05
    hindsight_goals: Count = 2
    memory: PositiveCount = 400_000
    random_steps: int = 6_600
    guided: bool = False
    guide_weight: float = 2.0
    total_steps: PositiveCount = 1_000_000
    validation_steps: int = 20_000
    validation_episodes: Annotated[int, Field(ge=1, le=1 << 16)] = 100
    hidden: Layers = (256, 256)
    seed: Seed = 0
    threads: Threads = 0

    def __post_init__(self) -> None:
        check_settings(self)


def make_sac(settings: SacSettings) -> Any:
    """Make an untrained Stable-Baselines3 model on its own vector environment.

    Raises:
        InvalidValueError: Too few random steps (hindsight needs a finished episode), guidance without an observed
            waypoint, or a negative weight.
    """
    if settings.guided and settings.observation != "goal_roadmap":
        raise InvalidValueError(f'guided needs observation="goal_roadmap", got {settings.observation!r}')
    shortest = settings.num_envs * EnvSettings().step_limit
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
            out, described, model, settings.num_envs * EnvSettings().step_limit, splits, options,
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
