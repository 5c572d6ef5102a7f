"""The Gymnasium environments: one simulation, or many in one batch."""

from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.envs.actions import ActionRule, ToolMotion
from greenhouse_gym.envs.image_observations import DepthObservation, PointsObservation, RgbObservation
from greenhouse_gym.envs.observations import Observation
from greenhouse_gym.envs.randomization import Randomization
from greenhouse_gym.envs.reach_task import Situation
from greenhouse_gym.envs.rewards import DenseReward, SparseReward, Transition, WayReward
from greenhouse_gym.envs.settings import EnvSettings
from greenhouse_gym.envs.tomato_reach import TomatoReachEnv
from greenhouse_gym.envs.vector import TomatoReachVectorEnv
from greenhouse_gym.rendering.cameras import DepthCamera

__all__ = [
    "ActionRule",
    "DenseReward",
    "DepthCamera",
    "DepthObservation",
    "EnvSettings",
    "Observation",
    "PlantMotion",
    "PointsObservation",
    "Randomization",
    "RgbObservation",
    "Situation",
    "SparseReward",
    "TomatoReachEnv",
    "TomatoReachVectorEnv",
    "ToolMotion",
    "Transition",
    "WayReward",
]
