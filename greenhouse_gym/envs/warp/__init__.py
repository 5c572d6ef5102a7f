"""Environments as kernels for CPU and GPU, by NVIDIA Warp: ``make_vec(..., backend="warp")``."""

from greenhouse_gym.common.extras import needs

with needs("warp"):
    import warp  # noqa: F401  the modules of this room import it without this error

from greenhouse_gym.envs.warp.bank import RATINGS
from greenhouse_gym.envs.warp.environment import WarpVectorEnv

__all__ = ["RATINGS", "WarpVectorEnv"]
