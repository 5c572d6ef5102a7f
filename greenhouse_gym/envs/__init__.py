"""The Gymnasium environments: one simulation, or many in one batch."""

from greenhouse_gym.envs.tomato_reach import TomatoReachEnv
from greenhouse_gym.envs.vector import TomatoReachVectorEnv

__all__ = ["TomatoReachEnv", "TomatoReachVectorEnv"]
