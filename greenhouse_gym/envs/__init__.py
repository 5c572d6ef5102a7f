"""Gymnasium environments: one simulation, or many in one batch."""

from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.envs.actions import ActionRule, ToolMotion
from greenhouse_gym.envs.contacts import CONTACT_GROUPS
from greenhouse_gym.envs.environment import GreenhouseEnv
from greenhouse_gym.envs.episodes import Episode, EpisodeSampler
from greenhouse_gym.envs.factory import make_env, make_vec, make_vec_env
from greenhouse_gym.envs.features import FEATURES, Feature
from greenhouse_gym.envs.image_observations import DepthObservation, PointsObservation, RgbObservation
from greenhouse_gym.envs.observations import Observation
from greenhouse_gym.envs.randomization import Randomization
from greenhouse_gym.envs.rewards import DenseReward, PathReward, SparseReward, Transition
from greenhouse_gym.envs.settings import EnvSettings
from greenhouse_gym.envs.state import State
from greenhouse_gym.envs.task import GoalTask, Outcome, Task
from greenhouse_gym.envs.tasks import LookReward, TomatoLook, TomatoReach
from greenhouse_gym.envs.vector import GreenhouseVectorEnv
from greenhouse_gym.rendering.cameras import DepthCamera

__all__ = [
    "CONTACT_GROUPS",
    "FEATURES",
    "ActionRule",
    "DenseReward",
    "DepthCamera",
    "DepthObservation",
    "EnvSettings",
    "Episode",
    "EpisodeSampler",
    "Feature",
    "GoalTask",
    "GreenhouseEnv",
    "GreenhouseVectorEnv",
    "LookReward",
    "Observation",
    "Outcome",
    "PathReward",
    "PlantMotion",
    "PointsObservation",
    "Randomization",
    "RgbObservation",
    "SparseReward",
    "State",
    "Task",
    "TomatoLook",
    "TomatoReach",
    "ToolMotion",
    "Transition",
    "make_env",
    "make_vec",
    "make_vec_env",
]
