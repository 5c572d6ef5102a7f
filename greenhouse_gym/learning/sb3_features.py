"""What Stable-Baselines3's networks are fed: observations brought to about one, group by group."""

from __future__ import annotations

from typing import Any

import numpy as np

from greenhouse_gym.envs.features import Layout, feature_slices
from greenhouse_gym.errors import MissingDependencyError

try:
    import torch
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
except ImportError as error:  # pragma: no cover - depends on the installation
    raise MissingDependencyError("stable-baselines3", "train") from error

CENTERS_AND_SCALES: dict[str, tuple[float, float]] = {
    "joint_position": (0.0, 1.5),
    "joint_velocity": (0.0, 1.0),
    "command_error": (0.0, 0.1),
    "grasp_offset": (0.0, 0.25),
    "target_position": (0.0, 0.5),
    "tip_position": (0.0, 0.5),
    "tool_axis": (0.0, 1.0),
    "clearance": (0.1, 0.1),
    "obstacle_direction": (0.0, 1.0),
    "unknown": (0.5, 0.5),
    "waypoint_offset": (0.0, 1.0),
    "waypoint_direction": (0.0, 0.5),
    "path": (0.5, 0.5),
    "clearance_rays": (0.1, 0.1),
}
"""Typical center and scale of each feature, which normalize it to about one. Features of other tasks are not scaled."""


class ScaledObservation(BaseFeaturesExtractor):  # type: ignore[misc]
    """Brings every group of the observation to about one, by `CENTERS_AND_SCALES`.

    Attributes:
        starts: Index of the first entry of each group.
    """

    def __init__(self, observation_space: Any, layout: Layout):
        super().__init__(observation_space, features_dim=int(np.prod(observation_space.shape)))
        self.starts = {name: place.start for name, place in feature_slices(layout).items()}
        pairs = np.concatenate([np.tile(CENTERS_AND_SCALES.get(name, (0.0, 1.0)), (size, 1)) for name, size in layout])
        self.register_buffer("center", torch.tensor(pairs[:, 0], dtype=torch.float32))
        self.register_buffer("scale", torch.tensor(pairs[:, 1], dtype=torch.float32))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Scaled observations."""
        return (observations - self.center) / self.scale
