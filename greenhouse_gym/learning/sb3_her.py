"""Stable-Baselines3's hindsight experience replay on the goal environment: a buffer that knows ends, and features."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.agents.goal_features import GOAL_FEATURES_SIZE, goal_features
from greenhouse_gym.envs.features import Layout, feature_slices
from greenhouse_gym.errors import MissingDependencyError

try:
    import torch
    from stable_baselines3 import HerReplayBuffer
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    from greenhouse_gym.learning.sb3_features import ScaledObservation
except ImportError as error:  # pragma: no cover - depends on the installation
    raise MissingDependencyError("stable-baselines3", "train") from error

_JUDGED_BY = ("collision", "steps", "previous_goal", "effort", "TimeLimit.truncated")
_DRAWS = 4


class _Kept(dict[str, Any]):
    """What is kept of an info. Nobody changes it, so nobody gets a copy: copies took a third of the training time."""

    def __deepcopy__(self, memo: dict[int, Any]) -> _Kept:
        return self


class GoalReplayBuffer(HerReplayBuffer):  # type: ignore[misc]
    """Hindsight replay (Andrychowicz et al., 2017) in which a transition that reaches its new goal ends the episode.

    Stable-Baselines3 keeps the old ends when it puts in new goals, so that reaching a goal pays again and again in
    hindsight, and once in reality. Goals at which a transition would begin are drawn anew a few times, since in reality
    the episode is over there; an arm that hardly moves would learn from little else. Of the infos, only what rewards
    and ends are judged by is kept.
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
        """Keep one step of all simulations."""
        kept: list[dict[str, Any]] = [_Kept((key, info[key]) for key in _JUDGED_BY if key in info) for info in infos]
        super().add(obs, next_obs, action, reward, done, kept)

    def _sample_goals(
        self, batch_indices: npt.NDArray[np.int64], env_indices: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        goals = super()._sample_goals(batch_indices, env_indices)
        here = self.observations["achieved_goal"][batch_indices, env_indices]
        task, nothing = self.env.get_attr("simulation")[0].task, np.zeros(len(here), dtype=np.bool_)
        for _ in range(_DRAWS - 1):
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


class GoalFeatures(BaseFeaturesExtractor):  # type: ignore[misc]
    """Scaled observation and `greenhouse_gym.agents.goal_features.goal_features`.

    Args:
        space: The goal environment's observation space.
        layout: Layout of its vector.
    """

    def __init__(self, space: spaces.Dict, layout: Layout):
        super().__init__(space, sum(size for _, size in layout) + GOAL_FEATURES_SIZE)
        self.scaled = ScaledObservation(space["observation"], layout)
        self._at = feature_slices(layout)

    def forward(self, observations: dict[str, Any]) -> Any:
        """Features (n, size + 18)."""
        seen = observations["observation"]
        achieved, desired = observations["achieved_goal"].float(), observations["desired_goal"].float()
        return torch.cat([self.scaled(seen), *goal_features(seen, achieved, desired, self._at, _lengths)], dim=1)


def _lengths(vectors: torch.Tensor) -> torch.Tensor:
    return vectors.norm(dim=-1, keepdim=True)
