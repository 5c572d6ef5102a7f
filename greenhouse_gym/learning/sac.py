"""SAC with hindsight experience replay by Stable-Baselines3 on the goal environment, with settings that learn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.extras import needs
from greenhouse_gym.envs.state import STEP_LIMIT
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.learning.sb3 import make_sb3_vec_env
from greenhouse_gym.learning.settings import SacSettings
from greenhouse_gym.learning.training_settings import env_options, require_joint_action

with needs("train"):
    import tensorboard  # noqa: F401  Stable-Baselines3 needs it, but imports it late
    import torch
    from stable_baselines3 import HerReplayBuffer

    from greenhouse_gym.learning.guided_sac import Demonstrator, GuidedSAC
    from greenhouse_gym.learning.sb3_features import policy_for
    from greenhouse_gym.learning.training_files import load_checkpoint, settings_of
    from greenhouse_gym.learning.training_report import TrainingReport, Validation
    from greenhouse_gym.learning.training_run import as_json, check_start, learn, making_model, training_in

_USED_KEYS = ("collision", "steps", "previous_goal", "effort", "TimeLimit.truncated")
_MAX_DRAWS = 4  # of a goal at which the transition would already start


class _SharedInfo(dict[str, Any]):
    """Part of an info that is never modified, so it is not copied: copies took a third of the training time."""

    def __deepcopy__(self, memo: dict[int, Any]) -> _SharedInfo:
        return self


class GoalReplayBuffer(HerReplayBuffer):  # type: ignore[misc]
    """Hindsight replay (Andrychowicz et al., 2017) in which a transition that reaches its new goal ends the episode.

    Stable-Baselines3 leaves the ends of episodes unchanged when it inserts new goals, so reaching a goal pays
    repeatedly in hindsight, but once in reality. Goals at which a transition would start are sampled again a few times,
    since the real episode would be over there; an arm that hardly moves would otherwise learn from little else. Only
    the parts of infos that rewards and ends depend on are stored.
    """

    def __init__(self, *arguments: Any, **keywords: Any):
        super().__init__(*arguments, **{**keywords, "copy_info_dict": True})

    def add(
        self,
        obs: dict[str, npt.NDArray[Any]],
        next_obs: dict[str, npt.NDArray[Any]],
        action: npt.NDArray[Any],
        reward: npt.NDArray[Any],
        done: npt.NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        """Store one step of all simulations."""
        stored: list[dict[str, Any]] = [
            _SharedInfo((key, info[key]) for key in _USED_KEYS if key in info) for info in infos
        ]
        super().add(obs, next_obs, action, reward, done, stored)

    def _sample_goals(
        self, batch_indices: npt.NDArray[np.int64], env_indices: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        goals = super()._sample_goals(batch_indices, env_indices)
        here = self.observations["achieved_goal"][batch_indices, env_indices]
        task, nothing = self.env.get_attr("simulation")[0].task, np.zeros(len(here), dtype=np.bool_)
        for _ in range(_MAX_DRAWS - 1):
            again = np.flatnonzero(task.evaluate_goals(here, goals, nothing).success)
            if not len(again):
                break
            goals[again] = super()._sample_goals(batch_indices[again], env_indices[again])
        return goals

    def _get_virtual_samples(
        self, batch_indices: npt.NDArray[np.int64], env_indices: npt.NDArray[np.int64], env: Any = None
    ) -> Any:
        samples = super()._get_virtual_samples(batch_indices, env_indices, env)
        ended = self.env.env_method(
            "compute_terminated",
            samples.next_observations["achieved_goal"].cpu().numpy(),
            samples.next_observations["desired_goal"].cpu().numpy(),
            self.infos[batch_indices, env_indices],
            indices=[0],
        )[0]
        return samples._replace(dones=self.to_torch(ended.astype(np.float32).reshape(-1, 1)))


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
