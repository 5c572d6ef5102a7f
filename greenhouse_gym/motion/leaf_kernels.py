"""Kernel of `greenhouse_gym.motion.leaf_contacts`."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import kernel
from greenhouse_gym.motion.collision_kernels import WORLD, Array, World, gap, memory_for


@kernel(f"void({WORLD}, f8[:, ::1], b1[::1])", writes=("hit",))
def geoms_in_contact(world: World, configurations: Array, hit: npt.NDArray[np.bool_]) -> None:
    """Mark the geoms (g,), except planes, that the arm touches in some of the configurations (k, n)."""
    memory = (*memory_for(world)[:5], hit)
    for i in range(len(configurations)):
        gap(world, configurations[i], 0.0, False, memory)
