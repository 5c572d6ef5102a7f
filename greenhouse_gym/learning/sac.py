"""SAC with hindsight experience replay by Stable-Baselines3 on the goal environment, with settings that learn."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.envs import EnvSettings
from greenhouse_gym.errors import InvalidValueError, require_seed
from greenhouse_gym.learning.folders import check_folder
from greenhouse_gym.learning.sb3 import make_sb3_vec_env
from greenhouse_gym.scene import SceneBank

with needs("train"):
    import tensorboard  # noqa: F401  what Stable-Baselines3 writes its curves with, and does not ask for at once
    import torch
    from stable_baselines3.common.logger import configure

    from greenhouse_gym.learning.checkpoints import NAME as CHECKPOINT
    from greenhouse_gym.learning.checkpoints import load_checkpoint, read_notes
    from greenhouse_gym.learning.demonstrated_sac import Demonstrated, Demonstrator
    from greenhouse_gym.learning.policies import save_policy
    from greenhouse_gym.learning.sac_report import SacProgress, SacReport
    from greenhouse_gym.learning.sb3_her import GoalFeatures, GoalReplayBuffer


@dataclass(frozen=True)
class SacSettings:
    """Settings of a training.

    Attributes:
        bank: Name or folder of the scene bank; its training split is trained on.
        robot: The arm.
        difficulty: Difficulties of the targets.
        observation: "goal", or "goal_waypoint", which also tells where the arm can go straight.
        reward: "dense" or "sparse". With the sparse one a crash costs what a success pays, so that arms which still
            crash often had better keep away from the plants; it learned little.
        num_envs: Simulations.
        updates_per_step: Gradient steps per step of all simulations.
        batch_size: Transitions per gradient step.
        learning_rate: Learning rate of actor, critics and entropy coefficient.
        discount: Discount of future rewards, per step.
        target_rate: How far the target critics move to the critics per gradient step.
        entropy_coefficient: Its value at the start. It adapts; much more than this, and staying alive to act at random
            is worth more than any success, which ends the episode.
        hindsight_goals: Transitions with a goal in hindsight per real one.
        memory: Transitions that are kept.
        random_steps: Steps with random actions before the first gradient step; enough for an episode of each
            simulation.
        guided: Whether these steps go where the waypoint says instead, from exactly so in the first simulation to with
            much noise in the last, and the actor is held near that rule.
        held: How much it is held, against what the critics say; see `Demonstrated`.
        total_steps: Steps of all simulations together.
        validation_steps: Steps between judgments of the policy without its noise, on rows that are trained on and on
            rows that are not.
        validation_episodes: Episodes of each judgment and split, always the same ones.
        hidden: Sizes of the hidden layers, of actor and critics each.
        seed: Seed of scenes, weights and noise.
        threads: Threads of the simulation; 0 uses all cores. The network has one: with more, its many small products
            wait for each other, on a busy machine most of the time.
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
    held: float = 2.0
    total_steps: int = 1_000_000
    validation_steps: int = 20_000
    validation_episodes: int = 100
    hidden: tuple[int, ...] = (256, 256)
    seed: int = 0
    threads: int = 0


def make_sac(settings: SacSettings) -> Any:
    """The Stable-Baselines3 model, untrained, on its own vector environment.

    Raises:
        InvalidValueError: There are too few random steps: hindsight needs an episode that has ended. Or they are to be
            guided, and no waypoint is observed. Or the actor is to be held by less than nothing.
    """
    if settings.guided and settings.observation != "goal_waypoint":
        raise InvalidValueError(f'guided needs observation="goal_waypoint", got {settings.observation!r}')
    whole = settings.num_envs * EnvSettings().step_limit
    if settings.random_steps < whole:
        raise InvalidValueError(
            f"random_steps must be at least {whole}, so that an episode of each of the {settings.num_envs} simulations "
            f"ends before anything is learned, got {settings.random_steps}"
        )
    if not (settings.held >= 0 and math.isfinite(settings.held)):
        raise InvalidValueError(f"held must be a finite number from 0 on, got {settings.held!r}")
    torch.set_num_threads(1)
    env = make_sb3_vec_env(settings.num_envs, seed=settings.seed, **env_options(settings))
    layout = env.get_attr("simulation")[0].observe.layout
    model = Demonstrated(
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
        model.demonstrator, model.held = Demonstrator(layout, settings.seed), settings.held
    return model


def train_sac(
    settings: SacSettings,
    out: str | Path,
    *,
    resume: bool = False,
    minutes: float | None = None,
    checkpoint_seconds: float = 60.0,
    tell: Callable[[SacProgress], None] = lambda progress: None,
) -> Path:
    """Train a policy and judge it now and then.

    ``out`` gets ``settings.json``, ``validation.csv`` (a line per judgment), ``tensorboard`` (the same, how the
    episodes of the training end, the reward's terms and the losses), ``checkpoint.safetensors`` now and then and at the
    end, also when interrupted, and then ``policy.json`` with its weights, which `PolicyAgent` plays without PyTorch. A
    resumed training goes on with the weights, the optimizers and the step count of the checkpoint, in new episodes and
    with an empty memory: it fills that by its policy, with noise, before it learns on.

    Args:
        settings: The settings.
        out: Folder for the results.
        resume: Go on from the checkpoint in ``out``; otherwise ``out`` must not hold one.
        minutes: Processor time after which it stops, as if interrupted.
        checkpoint_seconds: Time between checkpoints.
        tell: Gets each judgment at once.

    Returns:
        The path of the checkpoint, which `load_sac` makes a model from.

    Raises:
        InvalidValueError: There is nothing to resume, or something that would be overwritten, or the checkpoint was
            made with other settings.
        FileFormatError: The checkpoint is damaged.
        KeyboardInterrupt: The training was interrupted; what there was is written.
    """
    require_seed(settings.seed)
    out = Path(out)
    described = json.loads(json.dumps(asdict(settings)))
    check_folder(out / CHECKPOINT, lambda: read_notes(out)["settings"], described, "total_steps", resume)
    model = make_sac(settings)
    model.set_logger(configure(str(out / "tensorboard"), ["tensorboard"]))
    if resume:
        load_checkpoint(model, out)
        model.get_env().seed(settings.seed + model.num_timesteps)
        model.learning_starts = model.num_timesteps + settings.random_steps
        model.acts_at_random = False
    notes = {"algorithm": "SAC", "settings": described, "bank_sha256": SceneBank.open(settings.bank).sha256}
    write_atomically(out / "settings.json", json.dumps(described, indent=1) + "\n")
    report = SacReport(out, settings, env_options(settings), model, minutes, checkpoint_seconds, tell)
    try:
        if model.num_timesteps < settings.total_steps:
            model.learn(settings.total_steps - model.num_timesteps, callback=report, reset_num_timesteps=not resume)
    finally:
        report.finish()
        save_policy(model, out / "policy", notes)
        model.get_env().close()
    return out / CHECKPOINT


def load_sac(folder: str | Path) -> Any:
    """The Stable-Baselines3 model of a training's folder, on its own vector environment.

    Raises:
        FileFormatError: There is no checkpoint, or it is damaged.
    """
    described = read_notes(Path(folder))["settings"]
    tuples = {name: tuple(value) for name, value in described.items() if isinstance(value, list)}
    model = make_sac(SacSettings(**{**described, **tuples}))
    load_checkpoint(model, Path(folder))
    return model


def env_options(settings: SacSettings) -> dict[str, Any]:
    """Keywords of the environment that is trained on."""
    shared = ("bank", "robot", "difficulty", "observation", "reward", "threads")
    return {name: getattr(settings, name) for name in shared}
