"""Feature extractors for Stable-Baselines3's networks: observations scaled to about one, group by group."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from greenhouse_gym.agents.goal_features import GOAL_FEATURES, GOAL_FEATURES_SIZE, flaw_of, goal_features
from greenhouse_gym.common.extras import needs
from greenhouse_gym.envs.features import Layout, feature_slices
from greenhouse_gym.envs.observations import ObservationSpec

with needs("train"):
    import torch
    from stable_baselines3.common.preprocessing import is_image_space
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

CENTERS_AND_SCALES: dict[str, tuple[float, float]] = {
    "joint_position": (0.0, 1.5),
    "joint_velocity": (0.0, 1.0),
    "command_error": (0.0, 0.1),
    "grasp_offset": (0.0, 0.25),
    "target_position": (0.0, 0.5),
    "target_direction": (0.0, 1.0),
    "turn_to_target": (0.0, 1.0),
    "tip_position": (0.0, 0.5),
    "tool_axis": (0.0, 1.0),
    "clearance": (0.1, 0.1),
    "obstacle_direction": (0.0, 1.0),
    "unknown": (0.5, 0.5),
    "waypoint_offset": (0.0, 1.0),
    "waypoint_direction": (0.0, 0.5),
    "path": (0.5, 0.5),
    "goal_offset": (0.0, 1.0),
    "goal_direction": (0.0, 0.5),
    "goal_clearance": (0.1, 0.1),
    "gripper": (0.5, 0.5),
    "wrist_force": (0.0, 5.0),
    "fruit_radius": (0.03, 0.015),
    "fruit_left": (1.0, 1.0),
    "pedicel": (0.0, 0.05),
    "crate_offset": (0.0, 0.5),
}
"""Typical center and scale of each feature, which normalize it to about one. Features of your own are not scaled."""


def policy_for(observe: ObservationSpec) -> tuple[str, dict[str, Any]]:
    """Return the policy of Stable-Baselines3 for an observation, by name, and keywords of its feature extractor.

    Vectors of this package are scaled; a user's own observation comes as it is.
    """
    space: Any = observe.space
    size = sum(size for _, size in observe.layout)
    extractor: type[BaseFeaturesExtractor] | None
    if isinstance(space, spaces.Dict):
        fits = not flaw_of((*observe.layout, (GOAL_FEATURES, GOAL_FEATURES_SIZE)))
        goals = observe.has_goals and fits and space["observation"].shape == (size,)
        name, extractor = "MultiInputPolicy", GoalFeatures if goals else None
    else:
        name = "CnnPolicy" if is_image_space(space) else "MlpPolicy"
        extractor = ScaledObservation if size and space.shape == (size,) else None
    if extractor is None:
        return name, {}
    return name, {"features_extractor_class": extractor, "features_extractor_kwargs": {"layout": observe.layout}}


class ScaledObservation(BaseFeaturesExtractor):  # type: ignore[misc]
    """Scale every group of the observation to about one, by `CENTERS_AND_SCALES`.

    Attributes:
        starts: Index of the first entry of each group.
    """

    def __init__(self, observation_space: Any, layout: Layout):
        super().__init__(observation_space, features_dim=int(np.prod(observation_space.shape)))
        self.starts = {name: part.start for name, part in feature_slices(layout).items()}
        pairs = np.concatenate([np.tile(CENTERS_AND_SCALES.get(name, (0.0, 1.0)), (size, 1)) for name, size in layout])
        self.register_buffer("center", torch.tensor(pairs[:, 0], dtype=torch.float32))
        self.register_buffer("scale", torch.tensor(pairs[:, 1], dtype=torch.float32))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return scaled observations."""
        return (observations - self.center) / self.scale


class GoalFeatures(BaseFeaturesExtractor):  # type: ignore[misc]
    """Concatenate the scaled observation and `greenhouse_gym.agents.goal_features.goal_features`.

    Args:
        space: Observation space of the goal environment.
        layout: Layout of its vector part.
    """

    def __init__(self, space: spaces.Dict, layout: Layout):
        super().__init__(space, sum(size for _, size in layout) + GOAL_FEATURES_SIZE)
        self.scaled = ScaledObservation(space["observation"], layout)
        self._groups = feature_slices(layout)

    def forward(self, observations: dict[str, Any]) -> Any:
        """Return features (n, size + 18)."""
        values = observations["observation"]
        achieved, desired = observations["achieved_goal"].float(), observations["desired_goal"].float()
        return torch.cat(
            [self.scaled(values), *goal_features(values, achieved, desired, self._groups, _lengths)], dim=1
        )


def _lengths(vectors: torch.Tensor) -> torch.Tensor:
    return vectors.norm(dim=-1, keepdim=True)
