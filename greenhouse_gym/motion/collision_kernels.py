"""Kernels of collision checks: an arm of capsules among the shapes of a scene.

The arm is a chain of joints with capsules; spheres are capsules without length. The world is a tree of boxes over
spheres, capsules, ellipsoids, boxes and planes. Both are a few arrays, so that a single call takes a microsecond. The
first argument of most kernels is a tuple of:

- joints (n, 16): see `greenhouse_gym.motion.kinematics_kernels`;
- capsules (c, 11): index of the last joint before the capsule or -1, both ends in that joint's frame, radius, margin,
  and the masks ``contype`` and ``conaffinity``;
- pairs (p, 2): capsules that must not touch each other;
- geoms (g, 19): type as in MuJoCo, position, rotation by rows, size, ``contype``, ``conaffinity`` and margin;
- nodes (b, 9): center and half sizes of the boxes of the tree, margins included, their two children, and the geom of a
  leaf or -1;
- planes (k, 19): the geoms that are planes.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import inlined, kernel
from greenhouse_gym.geometry.segment_kernels import segment_to_box, segment_to_ellipsoid, segments_apart
from greenhouse_gym.motion.kinematics_kernels import joint_frames

Array = npt.NDArray[np.float64]
Pairs = npt.NDArray[np.int32]
World = tuple[Array, Array, Pairs, Array, Array, Array]

_PLANE, _SPHERE = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_SPHERE)
_CAPSULE, _BOX = int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_BOX)
_STACK = 128  # deeper than any tree with a median split
WORLD = "Tuple((f8[:, ::1], f8[:, ::1], i4[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]))"


@inlined
def _local(p, g):
    """Return a point in the frame of a geom."""
    x, y, z = p[0] - g[1], p[1] - g[2], p[2] - g[3]
    return (
        g[4] * x + g[7] * y + g[10] * z,
        g[5] * x + g[8] * y + g[11] * z,
        g[6] * x + g[9] * y + g[12] * z,
    )


@inlined
def near(g, a, b, radius):
    """Return whether the segment from a to b is nearer to a geom than a radius."""
    if radius <= 0.0:
        return False
    kind, size = int(g[0]), (g[13], g[14], g[15])
    if kind == _SPHERE:
        center, limit = (g[1], g[2], g[3]), radius + size[0]
        return segments_apart(a, b, center, center) < limit * limit
    if kind == _CAPSULE:
        x, y, z, limit = g[6] * size[1], g[9] * size[1], g[12] * size[1], radius + size[0]
        return segments_apart(a, b, (g[1] - x, g[2] - y, g[3] - z), (g[1] + x, g[2] + y, g[3] + z)) < limit * limit
    u, v = _local(a, g), _local(b, g)
    if kind == _PLANE:
        return min(u[2], v[2]) < radius
    if kind == _BOX:
        return segment_to_box(u, v, size) < radius * radius
    origin = (0.0, 0.0, 0.0)
    apart = math.sqrt(segments_apart(u, v, origin, origin))
    if apart >= radius + max(size[0], max(size[1], size[2])):
        return False
    return apart < radius + min(size[0], min(size[1], size[2])) or segment_to_ellipsoid(u, v, size) < radius


@inlined
def _distance(g, a, b):
    """Return the distance of the segment from a to b to a geom; inside a box it is 0."""
    kind, size, origin = int(g[0]), (g[13], g[14], g[15]), (0.0, 0.0, 0.0)
    u, v = _local(a, g), _local(b, g)
    if kind == _SPHERE:
        return math.sqrt(segments_apart(u, v, origin, origin)) - size[0]
    if kind == _CAPSULE:
        return math.sqrt(segments_apart(u, v, (0.0, 0.0, -size[1]), (0.0, 0.0, size[1]))) - size[0]
    if kind == _PLANE:
        return min(u[2], v[2])
    if kind == _BOX:
        return math.sqrt(segment_to_box(u, v, size))
    return segment_to_ellipsoid(u, v, size)


@inlined
def memory_for(world):
    """Return the memory of checks: joint frames, ends of capsules, a stack, a configuration, a motion and no marks."""
    n, frames, ends = len(world[0]), np.empty((len(world[0]), 18)), np.empty((len(world[1]), 6))
    return frames, ends, np.empty(_STACK, np.int64), np.empty(n), np.empty(n), np.empty(0, np.bool_)


@inlined
def place(joints, capsules, q, frames, ends):
    """Write both ends of each capsule in a configuration; the frames are memory."""
    joint_frames(joints, q, frames)
    for k in range(len(capsules)):
        c, j = capsules[k], int(capsules[k, 0])
        for end in range(2):
            x, y, z = c[1 + 3 * end], c[2 + 3 * end], c[3 + 3 * end]
            if j >= 0:
                f = frames[j]
                x, y, z = (
                    f[9] + (f[0] * x + f[1] * y + f[2] * z),
                    f[10] + (f[3] * x + f[4] * y + f[5] * z),
                    f[11] + (f[6] * x + f[7] * y + f[8] * z),
                )
            ends[k, 3 * end], ends[k, 3 * end + 1], ends[k, 3 * end + 2] = x, y, z


@inlined
def gap(world, q, limit, first, memory):
    """Return the smallest distance beyond the margins in a configuration if it is below a limit, else the limit.

    With ``first``, the search ends with -1 at any distance below the limit. ``memory`` is that of `memory_for`. If it
    has marks (g,), each geom of the tree that is nearer than the limit is marked and does not lower it.
    """
    joints, capsules, pairs, geoms, nodes, planes = world
    frames, ends, stack, marks = memory[0], memory[1], memory[2], memory[5]
    place(joints, capsules, q, frames, ends)
    for p in range(len(pairs)):
        i, k = pairs[p, 0], pairs[p, 1]
        a, b = (ends[i, 0], ends[i, 1], ends[i, 2]), (ends[i, 3], ends[i, 4], ends[i, 5])
        c, d = (ends[k, 0], ends[k, 1], ends[k, 2]), (ends[k, 3], ends[k, 4], ends[k, 5])
        radius = capsules[i, 7] + capsules[k, 7] + capsules[i, 8] + capsules[k, 8]
        reach, squared = radius + limit, segments_apart(a, b, c, d)
        if reach > 0.0 and squared < reach * reach:
            if first:
                return -1.0
            limit = math.sqrt(squared) - radius
    for k in range(len(capsules) - 1, -1, -1):  # the tool first: most collisions are its
        if capsules[k, 0] < 0 or len(nodes) == 0:
            continue
        a, b = (ends[k, 0], ends[k, 1], ends[k, 2]), (ends[k, 3], ends[k, 4], ends[k, 5])
        radius, offered, accepted = capsules[k, 7] + capsules[k, 8], int(capsules[k, 9]), int(capsules[k, 10])
        mx, my, mz = (a[0] + b[0]) / 2, (a[1] + b[1]) / 2, (a[2] + b[2]) / 2
        hx, hy, hz = abs(a[0] - b[0]) / 2 + radius, abs(a[1] - b[1]) / 2 + radius, abs(a[2] - b[2]) / 2 + radius
        for p in range(len(planes)):
            g = planes[p]
            if (int(g[17]) & offered or int(g[16]) & accepted) and near(g, a, b, radius + g[18] + limit):
                if first:
                    return -1.0
                limit = _distance(g, a, b) - radius - g[18]
        stack[0] = 0
        size = 1
        while size > 0:
            size -= 1
            n = nodes[stack[size]]
            if (
                abs(n[0] - mx) > n[3] + hx + limit
                or abs(n[1] - my) > n[4] + hy + limit
                or abs(n[2] - mz) > n[5] + hz + limit
            ):
                continue
            if n[8] < 0:
                stack[size], stack[size + 1] = int(n[6]), int(n[7])
                size += 2
                continue
            g = geoms[int(n[8])]
            if len(marks) > 0 and marks[int(n[8])]:
                continue
            if (int(g[17]) & offered or int(g[16]) & accepted) and near(g, a, b, radius + g[18] + limit):
                if len(marks) > 0:
                    marks[int(n[8])] = True
                    continue
                if first:
                    return -1.0
                limit = _distance(g, a, b) - radius - g[18]
    return limit


@kernel(f"i8({WORLD}, f8[:, ::1])")
def first_contact(world: World, configurations: Array) -> int:
    """Return the index of the first of some configurations (k, n) that is in collision, or -1."""
    memory = memory_for(world)
    for k in range(len(configurations)):
        if gap(world, configurations[k], 0.0, True, memory) < 0.0:
            return k
    return -1


@kernel(f"void({WORLD}, f8[:, ::1], b1[::1])", writes=("touching",))
def contacts(world: World, configurations: Array, touching: npt.NDArray[np.bool_]) -> None:
    """Write which of some configurations (k, n) are in collision, (k,)."""
    memory = memory_for(world)
    for k in range(len(configurations)):
        touching[k] = gap(world, configurations[k], 0.0, True, memory) < 0.0


@inlined
def contacts_along(world, start, motion, steps, memory):
    """Check the inner points of a motion; see `contact_along`."""
    q, checks, bits = memory[3], 0, 0
    while (1 << bits) <= steps - 1:
        bits += 1
    for index in range(1, 1 << bits):
        reverse = 0
        for bit in range(bits):
            reverse |= ((index >> bit) & 1) << (bits - 1 - bit)
        if reverse < steps:
            fraction = reverse / steps
            for j in range(len(q)):
                q[j] = start[j] + fraction * motion[j]
            checks += 1
            if gap(world, q, 0.0, True, memory) < 0.0:
                return checks
    return 0


@kernel(f"i8({WORLD}, f8[::1], f8[::1], i8)")
def contact_along(world: World, start: Array, motion: Array, steps: int) -> int:
    """Check the inner points of a straight motion from a configuration, in `collision.halving_order`.

    Returns:
        Number of checks up to the first collision, or 0 without a collision.
    """
    return contacts_along(world, start, motion, steps, memory_for(world))
