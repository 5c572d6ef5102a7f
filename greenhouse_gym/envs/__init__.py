"""The Gymnasium environments: one simulation, or many in one batch."""

from greenhouse_gym.envs.actions import ActionRule, ToolMotion
from greenhouse_gym.envs.image_observations import DepthObservation, PointsObservation, RgbObservation
from greenhouse_gym.envs.observations import Observation
from greenhouse_gym.envs.randomization import Randomization
from greenhouse_gym.envs.reach_task import State
from greenhouse_gym.envs.rewards import DenseReward, PathReward, SparseReward, Transition
from greenhouse_gym.envs.settings import EnvSettings
from greenhouse_gym.envs.tomato_reach import TomatoReachEnv
from greenhouse_gym.envs.vector import TomatoReachVectorEnv
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.scene.plant_motion import PlantMotion

__all__ = [
    "ActionRule",
    "DenseReward",
    "DepthCamera",
    "DepthObservation",
    "EnvSettings",
    "Observation",
    "PathReward",
    "PlantMotion",
    "PointsObservation",
    "Randomization",
    "RgbObservation",
    "SparseReward",
    "State",
    "TomatoReachEnv",
    "TomatoReachVectorEnv",
    "ToolMotion",
    "Transition",
]
