"""The Gymnasium environments: one simulation, or many in one batch."""

from greenhouse_gym.envs.cameras import DepthCamera
from greenhouse_gym.envs.observations import DepthObservation, PointsObservation
from greenhouse_gym.envs.randomization import Randomization
from greenhouse_gym.envs.tomato_reach import TomatoReachEnv
from greenhouse_gym.envs.vector import TomatoReachVectorEnv

__all__ = [
    "DepthCamera",
    "DepthObservation",
    "PointsObservation",
    "Randomization",
    "TomatoReachEnv",
    "TomatoReachVectorEnv",
]
