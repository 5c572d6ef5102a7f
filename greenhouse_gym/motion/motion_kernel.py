"""Kernel that checks many straight motions."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import kernel
from greenhouse_gym.motion.collision_kernels import WORLD, Array, World, free_inside, gap, memory_for


@kernel(f"i8({WORLD}, f8[::1], f8, f8[:, ::1], f8[:, ::1], b1, b1[::1])", writes=("starts", "ends", "free"))
def check_motions(
    world: World,
    reaches: Array,
    resolution: float,
    starts: Array,
    ends: Array,
    inside: bool,
    free: npt.NDArray[np.bool_],
) -> int:
    """Check straight motions between configurations, each up to its first collision.

    Args:
        world: The arm and the scene, see `greenhouse_gym.motion.collision_kernels`.
        reaches: (n,) largest motion of any point of the arm per radian of each joint, metres.
        resolution: Largest motion of these points between two checks, metres.
        starts: (k, n) radians.
        ends: (k, n) radians.
        inside: Whether the ends are known to be free.
        free: (k,) the result: whether a motion is free.

    Returns:
        The number of checks.
    """
    memory, total = memory_for(world, True, np.empty(0, np.bool_)), 0
    q = memory[0]
    for k in range(len(starts)):
        free[k] = True
        for end in range(0 if inside else 2):
            if free[k]:
                for j in range(len(q)):
                    q[j] = starts[k, j] if end else ends[k, j]
                free[k] = gap(world, 0.0, memory) >= 0.0
                total += 1
        if free[k]:
            checks = free_inside(world, reaches, resolution, starts[k], ends[k], memory)
            free[k] = checks >= 0
            total += abs(checks)
    return total
