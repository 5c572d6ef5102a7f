"""Kernel of `greenhouse_gym.motion.clearance`."""

from __future__ import annotations

from greenhouse_gym.common.jit import kernel
from greenhouse_gym.motion.collision_kernels import WORLD, Array, World, gap, memory_for


@kernel(f"void({WORLD}, f8[:, ::1], f8, f8, f8[::1])", writes=("gaps",))
def smallest_gaps(world: World, configurations: Array, slack: float, floor: float, gaps: Array) -> None:
    """Write the smallest distances beyond the margins in some configurations (k, n), (k,).

    They are at most 0. Those that exceed the smallest one before them, or ``floor`` if that is larger, by more than
    ``slack`` may be written as 0.
    """
    memory, smallest = memory_for(world), 0.0
    for k in range(len(configurations)):
        limit = min(smallest + slack, 0.0)
        found = gap(world, configurations[k], limit, False, memory)
        gaps[k] = found if found < limit else 0.0
        smallest = max(min(smallest, found), floor)
