"""SAC with hindsight experience replay by Stable-Baselines3 on the goal environment, with settings that learn."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from greenhouse_gym.errors import MissingDependencyError, require_seed
from greenhouse_gym.evaluation import Evaluation, evaluate
from greenhouse_gym.integrations.sb3 import Sb3Agent, make_sb3_vec_env

try:
    import torch
    from stable_baselines3 import SAC
    from stable_baselines3.common.callbacks import BaseCallback

    from greenhouse_gym.integrations.sb3_her import GoalFeatures, GoalReplayBuffer
except ImportError as error:  # pragma: no cover - depends on the installation
    raise MissingDependencyError("stable-baselines3", "train") from error


@dataclass(frozen=True)
class SacSettings:
    """Settings of a training.

    Attributes:
        bank: Name or folder of the scene bank; its training split is trained on.
        robot: The arm.
        difficulty: Difficulties of the targets.
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
        random_steps: Steps with random actions before the first gradient step.
        hidden: Sizes of the hidden layers, of actor and critics each.
        seed: Seed of scenes, weights and noise.
        threads: Threads of the simulation; 0 uses all cores. The network has one: with more, its many small products
            wait for each other, on a busy machine most of the time.
    """

    bank: str = "mini"
    robot: str = "ur5e"
    difficulty: tuple[str, ...] = ("easy",)
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
    hidden: tuple[int, ...] = (256, 256)
    seed: int = 0
    threads: int = 0


@dataclass(frozen=True)
class SacProgress:
    """How far a training is, and how good the policy without its noise.

    Attributes:
        steps: Steps of all simulations together.
        updates: Gradient steps.
        seconds: Processor time of the training, without that of the judging.
        train: Episodes of the training split.
        validation: Episodes of the validation split, whose rows are not trained on. The test split is for the end.
    """

    steps: int
    updates: int
    seconds: float
    train: Evaluation
    validation: Evaluation


def make_sac(settings: SacSettings) -> Any:
    """The Stable-Baselines3 model, untrained, on its own vector environment."""
    torch.set_num_threads(1)
    env = make_sb3_vec_env(settings.num_envs, seed=settings.seed, **_env_options(settings))
    layout = env.get_attr("simulation")[0].observe.layout
    return SAC(
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


def train_sac(
    settings: SacSettings,
    total_steps: int,
    *,
    minutes: float | None = None,
    every: int = 20_000,
    episodes: int = 100,
    tell: Callable[[SacProgress], None] = lambda progress: None,
) -> tuple[Any, list[SacProgress]]:
    """Train a policy and judge it now and then.

    Args:
        settings: The settings.
        total_steps: Steps of all simulations together.
        minutes: Processor time after which it stops earlier.
        every: Steps from one judgment to the next.
        episodes: Episodes per judgment and split; they are the same each time.
        tell: Gets each judgment at once.

    Returns:
        The Stable-Baselines3 model and the judgments.
    """
    require_seed(settings.seed)
    model = make_sac(settings)
    report = _Report(settings, minutes, every, episodes, tell)
    try:
        model.learn(total_steps, callback=report)
    finally:
        model.get_env().close()
    return model, report.curve


def _env_options(settings: SacSettings) -> dict[str, Any]:
    shared = ("bank", "robot", "difficulty", "reward", "threads")
    return {"observation": "goal", **{name: getattr(settings, name) for name in shared}}


class _Report(BaseCallback):  # type: ignore[misc]
    """Judges the policy now and then, and stops the training in time."""

    def __init__(
        self,
        settings: SacSettings,
        minutes: float | None,
        every: int,
        episodes: int,
        tell: Callable[[SacProgress], None],
    ):
        super().__init__()
        self.curve: list[SacProgress] = []
        self._options, self._seed, self._tell = _env_options(settings), settings.seed, tell
        self._limit = None if minutes is None else 60.0 * minutes
        self._every, self._next, self._episodes = every, every, episodes
        self._began = time.process_time()
        self._judging = 0.0

    def _on_step(self) -> bool:
        seconds = time.process_time() - self._began - self._judging
        if self.num_timesteps >= self._next:
            self._next += self._every
            shown = [self._judge(split) for split in ("train", "validation")]
            self.curve.append(SacProgress(self.num_timesteps, self.model._n_updates, round(seconds, 1), *shown))
            self._tell(self.curve[-1])
            self._judging = time.process_time() - self._began - seconds
        return self._limit is None or seconds < self._limit

    def _judge(self, split: str) -> Evaluation:
        agent = Sb3Agent(self.model)
        return evaluate(
            agent, split, self._episodes, seed=10_000, progress=False, num_envs=self._episodes, **self._options
        )
