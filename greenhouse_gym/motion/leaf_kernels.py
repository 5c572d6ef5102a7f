"""Kernel of `greenhouse_gym.motion.leaf_contacts`."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import kernel
from greenhouse_gym.motion.collision_kernels import WORLD, Array, World, memory_for, near, place


@kernel(f"void({WORLD}, f8[:, ::1], b1[::1])", writes=("hit",))
def geoms_in_contact(world: World, configurations: Array, hit: npt.NDArray[np.bool_]) -> None:
    """Mark the geoms (g,), except planes, that the arm touches in some of the configurations (k, n)."""
    joints, capsules, _, geoms, nodes, _ = world
    frames, ends, stack, _, _ = memory_for(world)
    for i in range(len(configurations)):
        place(joints, capsules, configurations[i], frames, ends)
        for k in range(len(capsules)):
            if capsules[k, 0] < 0 or len(nodes) == 0:
                continue
            a, b = (ends[k, 0], ends[k, 1], ends[k, 2]), (ends[k, 3], ends[k, 4], ends[k, 5])
            radius, offered, accepted = capsules[k, 7] + capsules[k, 8], int(capsules[k, 9]), int(capsules[k, 10])
            mx, my, mz = (a[0] + b[0]) / 2, (a[1] + b[1]) / 2, (a[2] + b[2]) / 2
            hx, hy, hz = abs(a[0] - b[0]) / 2 + radius, abs(a[1] - b[1]) / 2 + radius, abs(a[2] - b[2]) / 2 + radius
            stack[0] = 0
            size = 1
            while size > 0:
                size -= 1
                n = nodes[stack[size]]
                if abs(n[0] - mx) > n[3] + hx or abs(n[1] - my) > n[4] + hy or abs(n[2] - mz) > n[5] + hz:
                    continue
                if n[8] < 0:
                    stack[size], stack[size + 1] = int(n[6]), int(n[7])
                    size += 2
                    continue
                g, leaf = geoms[int(n[8])], int(n[8])
                if not hit[leaf] and (int(g[17]) & offered or int(g[16]) & accepted):
                    hit[leaf] = near(g, a, b, radius + g[18])
