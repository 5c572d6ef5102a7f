"""Stable-Baselines3's hindsight experience replay on the goal environment: a buffer that knows ends, and features."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.errors import MissingDependencyError

try:
    import torch
    from stable_baselines3 import HerReplayBuffer
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
except ImportError as error:  # pragma: no cover - depends on the installation
    raise MissingDependencyError("stable-baselines3", "train") from error

_JUDGED_BY = ("collision", "steps", "previous_goal", "effort", "TimeLimit.truncated")


class _Kept(dict[str, Any]):
    """What is kept of an info. Nobody changes it, so nobody gets a copy: copies took a third of the training time."""

    def __deepcopy__(self, memo: dict[int, Any]) -> _Kept:
        return self


class GoalReplayBuffer(HerReplayBuffer):  # type: ignore[misc]
    """Hindsight replay (Andrychowicz et al., 2017) in which a transition that reaches its new goal ends the episode.

    Stable-Baselines3 keeps the old ends when it puts in new goals, so that reaching a goal pays again and again in
    hindsight, and once in reality. Of the infos, only what rewards and ends are judged by is kept.
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
    """Scaled observation, both goals, and the way from one to the other in decimetres, which decides at the end."""

    def __init__(self, space: spaces.Dict):
        box = space["observation"]
        assert isinstance(box, spaces.Box)
        super().__init__(space, box.shape[0] + 9)
        bound = np.minimum(np.maximum(np.abs(box.low), np.abs(box.high)), 3.0)
        self.register_buffer("scale", torch.as_tensor(bound))

    def forward(self, observations: dict[str, Any]) -> Any:
        """Features (n, size + 9)."""
        achieved, desired = observations["achieved_goal"].float(), observations["desired_goal"].float()
        way = (10.0 * (desired - achieved)).clamp(-3.0, 3.0)
        return torch.cat([observations["observation"] / self.scale, achieved, desired, way], dim=1)
