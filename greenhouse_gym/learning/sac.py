"""SAC with hindsight experience replay by Stable-Baselines3 on the goal environment, with settings that learn."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from greenhouse_gym.common.extras import needs
from greenhouse_gym.envs import EnvSettings
from greenhouse_gym.errors import InvalidValueError, require_seed
from greenhouse_gym.learning.sb3 import make_sb3_vec_env

with needs("train"):
    import tensorboard  # noqa: F401  Stable-Baselines3 needs it, but imports it late
    import torch

    from greenhouse_gym.learning.guided_sac import Demonstrator, GuidedSAC
    from greenhouse_gym.learning.sb3_features import GoalFeatures
    from greenhouse_gym.learning.sb3_her import GoalReplayBuffer
    from greenhouse_gym.learning.training_files import load_checkpoint, read_notes
    from greenhouse_gym.learning.training_run import TrainingReport, Validation, as_json, check_start, learn, set_up


@dataclass(frozen=True)
class SacSettings:
    """Settings of a training by SAC.

    Attributes:
        bank: Name or folder of the scene bank; its training split is trained on.
        robot: The arm.
        difficulty: Difficulties of the targets.
        observation: "goal", or "goal_roadmap", which adds the next waypoint of a collision-free path.
        reward: "dense" or "sparse". With the sparse one a collision costs what a success pays, so arms that still
            collide often learn to keep away from the plants; it learned little.
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
    difficulty: tuple[str, ...] = ("easy",)
    observation: str = "goal"
    reward: str = "dense"
    num_envs: int = 32
    updates_per_step: int = 8
    batch_size: int = 256
    learning_rate: float = 1e-3
    discount: float = 0.97
    target_rate: float = 0.02
    entropy_coefficient: float = 0.05
    hindsight_goals: int = 2
    memory: int = 400_000
    random_steps: int = 6_600
    guided: bool = False
    guide_weight: float = 2.0
    total_steps: int = 1_000_000
    validation_steps: int = 20_000
    validation_episodes: int = 100
    hidden: tuple[int, ...] = (256, 256)
    seed: int = 0
    threads: int = 0


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
    if not (settings.guide_weight >= 0 and math.isfinite(settings.guide_weight)):
        raise InvalidValueError(f"guide_weight must be a finite number from 0 on, got {settings.guide_weight!r}")
    torch.set_num_threads(1)
    env = make_sb3_vec_env(settings.num_envs, seed=settings.seed, **env_options(settings))
    layout = env.get_attr("simulation")[0].observe.layout
    model = GuidedSAC(
        "MultiInputPolicy",
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
        policy_kwargs={
            "net_arch": list(settings.hidden),
            "features_extractor_class": GoalFeatures,
            "features_extractor_kwargs": {"layout": layout},
        },
        seed=settings.seed,
        device="cpu",
    )
    if settings.guided:
        model.demonstrator, model.guide_weight = Demonstrator(layout, settings.seed), settings.guide_weight
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
        KeyboardInterrupt: The training was interrupted; its results are written.
    """
    require_seed(settings.seed)
    out, described = Path(out), as_json(settings)
    check_start(out, described, resume)
    model = make_sac(settings)
    set_up(model, out, described, resume)
    if resume:
        model.learning_starts = model.num_timesteps + settings.random_steps
        model.explores = False
    options = {"num_envs": settings.validation_episodes, **env_options(settings)}
    report = TrainingReport(
        out, described, model, settings.num_envs * EnvSettings().step_limit, ("train", "validation"), options,
        time_limit, checkpoint_seconds, on_validation=on_progress,
    )  # fmt: skip
    return learn(model, report, resume, algorithm="SAC")


def load_sac(folder: str | Path) -> Any:
    """Load the Stable-Baselines3 model of a training's folder, on its own vector environment.

    Raises:
        FileFormatError: The checkpoint is missing or damaged.
    """
    described = read_notes(Path(folder))["settings"]
    tuples = {name: tuple(value) for name, value in described.items() if isinstance(value, list)}
    model = make_sac(SacSettings(**{**described, **tuples}))
    load_checkpoint(model, Path(folder))
    return model


def env_options(settings: SacSettings) -> dict[str, Any]:
    """Return the keywords of the environment that is trained on."""
    shared = ("bank", "robot", "difficulty", "observation", "reward", "threads")
    return {name: getattr(settings, name) for name in shared}
