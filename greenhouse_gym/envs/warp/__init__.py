"""Environments as kernels for CPU and GPU, by NVIDIA Warp: ``make_vec(..., backend="warp")``."""

from greenhouse_gym.envs.warp.bank import RATINGS
from greenhouse_gym.envs.warp.environment import WarpVectorEnv

__all__ = ["RATINGS", "WarpVectorEnv"]
