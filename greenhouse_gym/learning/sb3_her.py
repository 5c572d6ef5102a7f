"""Hindsight experience replay of Stable-Baselines3, in which a transition that reaches its goal ends the episode."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.extras import needs

with needs("train"):
    from stable_baselines3 import HerReplayBuffer

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
