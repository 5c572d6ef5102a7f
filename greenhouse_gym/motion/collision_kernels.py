"""Kernels of collision checks: an arm of capsules among the shapes of a scene.

The arm is a chain of joints with capsules; spheres are capsules without length. The world is a tree of boxes over
spheres, capsules, ellipsoids, boxes and planes. Both are a few arrays, so that a single call takes a microsecond. The
first argument of most kernels is a tuple of:

- joints (n, 16): see `greenhouse_gym.motion.kinematics_kernels`;
- capsules (c, 11): index of the last joint before the capsule or -1, both ends in that joint's frame, radius, margin,
  and the masks ``contype`` and ``conaffinity``;
- pairs (p, 2): capsules that must not touch each other;
- geoms (g, 19): type as in MuJoCo, position, rotation by rows, size, ``contype``, ``conaffinity`` and margin;
- boxes (b, 6, 8) and children (b, 8): a tree over the geoms, see `greenhouse_gym.motion.wide_tree_kernel`, margins
  included;
- planes (k, 19): the geoms that are planes, which the tree leaves out.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import allocating, inlined, kernel
from greenhouse_gym.geometry.segment_kernels import dot, segment_to_box, segment_to_ellipsoid, segments_apart
from greenhouse_gym.motion.kinematics_kernels import joint_frames
from greenhouse_gym.motion.wide_tree_kernel import WIDTH

Array = npt.NDArray[np.float64]
Pairs = npt.NDArray[np.int32]
World = tuple[Array, Array, Pairs, Array, npt.NDArray[np.float32], npt.NDArray[np.int32], Array]

_PLANE, _SPHERE = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_SPHERE)
_CAPSULE, _BOX = int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_BOX)
GAPS, CONTACTS, FIRST = range(3)
"""Results of `smallest_gaps`: distances, collisions, or the first collision."""

_STACK = 256  # more than any tree with a median split needs
_ZERO = np.float32(0)
_ROUNDING = 1e-9  # metres: more than double precision loses
WORLD = "Tuple((f8[:, ::1], f8[:, ::1], i4[:, ::1], f8[:, ::1], f4[:, :, ::1], i4[:, ::1], f8[:, ::1]))"


@inlined
def _local(p, geoms, i):
    """Return a point in the frame of a geom."""
    x, y, z = p[0] - geoms[i, 1], p[1] - geoms[i, 2], p[2] - geoms[i, 3]
    return (
        geoms[i, 4] * x + geoms[i, 7] * y + geoms[i, 10] * z,
        geoms[i, 5] * x + geoms[i, 8] * y + geoms[i, 11] * z,
        geoms[i, 6] * x + geoms[i, 9] * y + geoms[i, 12] * z,
    )


@inlined
def near(geoms, i, a, b, radius):
    """Return whether the segment from a to b is nearer to a geom than a radius."""
    if radius <= 0.0:
        return False
    kind, size = int(geoms[i, 0]), (geoms[i, 13], geoms[i, 14], geoms[i, 15])
    if _PLANE < kind <= _CAPSULE:  # a sphere or a capsule
        half, limit = 0.0 if kind == _SPHERE else size[1], radius + size[0]
        x, y, z = geoms[i, 6] * half, geoms[i, 9] * half, geoms[i, 12] * half
        c = (geoms[i, 1] - x, geoms[i, 2] - y, geoms[i, 3] - z)
        d = (geoms[i, 1] + x, geoms[i, 2] + y, geoms[i, 3] + z)
        return segments_apart(a, b, c, d) < limit * limit
    u, v = _local(a, geoms, i), _local(b, geoms, i)
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
def _distance(geoms, i, a, b):
    """Return the distance of the segment from a to b to a geom; inside a box it is 0."""
    kind, size = int(geoms[i, 0]), (geoms[i, 13], geoms[i, 14], geoms[i, 15])
    u, v = _local(a, geoms, i), _local(b, geoms, i)
    if _PLANE < kind <= _CAPSULE:  # a sphere or a capsule
        half = 0.0 if kind == _SPHERE else size[1]
        return math.sqrt(segments_apart(u, v, (0.0, 0.0, -half), (0.0, 0.0, half))) - size[0]
    if kind == _PLANE:
        return min(u[2], v[2])
    if kind == _BOX:
        return math.sqrt(segment_to_box(u, v, size))
    return segment_to_ellipsoid(u, v, size)


@inlined
def lowered(geoms, i, a, b, mask, radius, limit, first):
    """Return the distance of a segment to a geom beyond a radius and margin if it is below a limit, else the limit.

    With ``first``, any such distance is -1. The mask is that of ``contype`` and ``conaffinity`` of the segment.
    """
    margin = geoms[i, 18]
    if not (int(geoms[i, 17]) & mask[0] or int(geoms[i, 16]) & mask[1]):
        return limit
    if not near(geoms, i, a, b, radius + margin + limit):
        return limit
    return -1.0 if first else _distance(geoms, i, a, b) - radius - margin


@allocating
def memory_for(world, first, marks):
    """Return the memory of `gap`.

    Args:
        world: The arm and the scene.
        first: True to end at any contact.
        marks: (g,) becomes True for each geom of the tree that is nearer than the limit, which then is not lowered;
            (0,) to leave it out.

    Returns:
        The configuration to be checked, a motion, joint frames, capsules where they are now, a stack, and the
        arguments.
    """
    # bool, because numba compiles everything twice for a literal
    n, frames, placed = len(world[0]), np.empty((len(world[0]), 18)), np.empty((len(world[1]), 10))
    for k in range(len(placed)):
        c = world[1][k]
        along = (c[4] - c[1], c[5] - c[2], c[6] - c[3])
        placed[k, 9] = math.sqrt(dot(along, along)) / 2.0 + c[7] + c[8] + _ROUNDING
    return np.empty(n), np.empty(n), frames, placed, np.empty(_STACK, np.int64), bool(first), marks


@inlined
def _place(joints, capsules, q, frames, placed):
    """Write the frames of the joints, and both ends and the middle of each capsule, in a configuration."""
    joint_frames(joints, q, frames)
    for k in range(len(capsules)):
        j = int(capsules[k, 0])
        for end in range(2):
            x, y, z = capsules[k, 1 + 3 * end], capsules[k, 2 + 3 * end], capsules[k, 3 + 3 * end]
            if j >= 0:
                x, y, z = (
                    frames[j, 9] + (frames[j, 0] * x + frames[j, 1] * y + frames[j, 2] * z),
                    frames[j, 10] + (frames[j, 3] * x + frames[j, 4] * y + frames[j, 5] * z),
                    frames[j, 11] + (frames[j, 6] * x + frames[j, 7] * y + frames[j, 8] * z),
                )
            placed[k, 3 * end], placed[k, 3 * end + 1], placed[k, 3 * end + 2] = x, y, z
        for axis in range(3):
            placed[k, 6 + axis] = (placed[k, axis] + placed[k, 3 + axis]) / 2.0


@inlined
def _segment(placed, k):
    return (placed[k, 0], placed[k, 1], placed[k, 2]), (placed[k, 3], placed[k, 4], placed[k, 5])


@inlined
def _capsule(placed, k):
    """Return middle and half axis of a capsule, its components without signs, and its lengths across each axis."""
    middle = (np.float32(placed[k, 6]), np.float32(placed[k, 7]), np.float32(placed[k, 8]))
    x = np.float32((placed[k, 3] - placed[k, 0]) / 2.0)
    y = np.float32((placed[k, 4] - placed[k, 1]) / 2.0)
    z = np.float32((placed[k, 5] - placed[k, 2]) / 2.0)
    across = (np.sqrt(y * y + z * z), np.sqrt(z * z + x * x), np.sqrt(x * x + y * y))
    return middle, (x, y, z), (abs(x), abs(y), abs(z)), across


@inlined
def _push_near(boxes, children, n, capsule, radius, stack, size):
    """Put the children of a node on a stack whose boxes a capsule may meet; return the new size of the stack.

    Axes that may separate a segment from a box are those of the box and their products with the segment.
    """
    (x, y, z), half, sizes, across = capsule
    rx, ry, rz = sizes[0] + radius, sizes[1] + radius, sizes[2] + radius
    ax, ay, az = radius * across[0], radius * across[1], radius * across[2]
    met = 0
    for k in range(WIDTH):  # no branches and no stores, for vector instructions
        dx, dy, dz = boxes[n, 0, k] - x, boxes[n, 1, k] - y, boxes[n, 2, k] - z
        ex, ey, ez = boxes[n, 3, k], boxes[n, 4, k], boxes[n, 5, k]
        apart = abs(dx) - (ex + rx)
        other = abs(dy) - (ey + ry)
        apart = other if other > apart else apart
        other = abs(dz) - (ez + rz)
        apart = other if other > apart else apart
        other = abs(dy * half[2] - dz * half[1]) - (ey * sizes[2] + ez * sizes[1] + ax)
        apart = other if other > apart else apart
        other = abs(dz * half[0] - dx * half[2]) - (ez * sizes[0] + ex * sizes[2] + ay)
        apart = other if other > apart else apart
        other = abs(dx * half[1] - dy * half[0]) - (ex * sizes[1] + ey * sizes[0] + az)
        apart = other if other > apart else apart
        met |= (1 << k) if apart <= _ZERO else 0
    k = 0
    while met > 0:
        if met & 1:
            stack[size] = children[n, k]
            size += 1
        met >>= 1
        k += 1
    return size


@inlined
def gap(world, limit, memory):
    """Return the smallest distance beyond the margins if it is below a limit, else the limit.

    The configuration is that of the memory, see `memory_for`. If the memory says so, the result is -1 at any distance
    below the limit, which is at least 0 then.
    """
    _place(world[0], world[1], memory[0], memory[2], memory[3])
    limit = _gap_of_arm(world, limit, memory)
    return limit if memory[5] and limit < 0.0 else _gap_to_world(world, limit, memory)


@inlined
def _gap_of_arm(world, limit, memory):
    """Return the smallest distance between parts of the arm, see `gap`."""
    capsules, pairs, placed = world[1], world[2], memory[3]
    for p in range(len(pairs)):
        i, k = int(pairs[p, 0]), int(pairs[p, 1])
        between = (placed[i, 6] - placed[k, 6], placed[i, 7] - placed[k, 7], placed[i, 8] - placed[k, 8])
        reach = placed[i, 9] + placed[k, 9] + limit
        if reach < 0.0 or dot(between, between) > reach * reach:
            continue
        a, b = _segment(placed, i)
        c, d = _segment(placed, k)
        radius = capsules[i, 7] + capsules[k, 7] + capsules[i, 8] + capsules[k, 8]
        reach, squared = radius + limit, segments_apart(a, b, c, d)
        if reach > 0.0 and squared < reach * reach:
            if memory[5]:
                return -1.0
            limit = math.sqrt(squared) - radius
    return limit


@inlined
def _gap_to_world(world, limit, memory):
    """Return the smallest distance of the arm to the scene, see `gap`."""
    capsules, geoms, boxes, children, planes = world[1], world[3], world[4], world[5], world[6]
    placed, stack, first, marks = memory[3], memory[4], memory[5], memory[6]
    any_contact = first or len(marks) > 0
    for k in range(len(capsules) - 1, -1, -1):  # the tool first: most collisions are its
        if capsules[k, 0] < 0 or len(boxes) == 0:
            continue
        a, b = _segment(placed, k)
        radius, mask = capsules[k, 7] + capsules[k, 8], (int(capsules[k, 9]), int(capsules[k, 10]))
        for p in range(len(planes)):
            away = (placed[k, 6] - planes[p, 1], placed[k, 7] - planes[p, 2], placed[k, 8] - planes[p, 3])
            height = dot(away, (planes[p, 6], planes[p, 9], planes[p, 12]))
            if height < placed[k, 9] + planes[p, 18] + limit:
                limit = lowered(planes, p, a, b, mask, radius, limit, first)
        capsule = _capsule(placed, k)
        stack[0] = 0
        size = 1
        while size > 0 and not (first and limit < 0.0):
            size -= 1
            n = stack[size]
            if n >= 0:
                size = _push_near(boxes, children, n, capsule, np.float32(radius + limit), stack, size)
            elif len(marks) == 0:
                limit = lowered(geoms, -1 - n, a, b, mask, radius, limit, first)
            elif not marks[-1 - n]:
                marks[-1 - n] = lowered(geoms, -1 - n, a, b, mask, radius, limit, any_contact) < limit
        if first and limit < 0.0:
            return -1.0
    return limit


@inlined
def free_inside(world, reaches, resolution, a, b, memory):
    """Check the inner points of the motion between two free configurations, in `collision.halving_order`.

    Returns:
        The number of checks, negative if the motion is not free.
    """
    start, end, length, q, motion = a, b, 0.0, memory[0], memory[1]
    for j in range(len(a)):
        if a[j] != b[j]:
            if a[j] > b[j]:
                start, end = b, a
            break
    for j in range(len(a)):
        motion[j] = end[j] - start[j]
        length += reaches[j] * abs(motion[j])
    steps = math.ceil(length / resolution)
    checks, bits = 0, 0
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
            if gap(world, 0.0, memory) < 0.0:
                return -checks
    return checks


@inlined
def _moved_less(one, other, limit):
    """Return whether no end of a capsule has moved by a limit or more between two positions (c, 6)."""
    for k in range(len(one) - 1, -1, -1):
        for end in range(0, 6, 3):
            x, y, z = (
                one[k, end] - other[k, end],
                one[k, end + 1] - other[k, end + 1],
                one[k, end + 2] - other[k, end + 2],
            )
            if x * x + y * y + z * z >= limit * limit:
                return False
    return True


@kernel(f"i8({WORLD}, f8[:, ::1], i8, f8, f8, f8[::1], b1[::1])", writes=("gaps", "marks"))
def smallest_gaps(
    world: World,
    configurations: Array,
    wanted: int,
    largest: float,
    enough: float,
    gaps: Array,
    marks: npt.NDArray[np.bool_],
) -> int:
    """Write the smallest distances beyond the margins in some configurations (k, n).

    Args:
        world: The arm and the scene.
        configurations: (k, n) radians.
        wanted: `GAPS` for distances, `CONTACTS` for -1 in each collision, `FIRST` to end at the first one.
        largest: Larger distances are written as this; 0 unless distances are wanted.
        enough: Configurations are left out whose distance is more than this, as distances in earlier ones show: no
            point of the arm has moved farther. If negative, they must exceed the smallest distance so far by its
            amount. With inf, none is left out.
        gaps: (k,) the result; inf for those left out.
        marks: (g,) becomes True for each geom, except planes, in contact in some configuration; (0,) to leave it out.

    Returns:
        The number of configurations decided.
    """
    count, skips, smallest = len(configurations), enough < np.inf, np.inf
    memory = memory_for(world, wanted != GAPS and not skips, marks)
    q, placed = memory[0], memory[3]
    positions = np.empty((count if skips else 0, len(placed), 6))
    for k in range(count if skips else 0):
        gaps[k] = 0.0
        for j in range(len(q)):
            q[j] = configurations[k, j]
        _place(world[0], world[1], q, memory[2], placed)
        for i in range(len(placed)):
            for j in range(6):
                positions[k, i, j] = placed[i, j]
    for k in range(count):
        if skips and gaps[k] == np.inf:
            continue
        for j in range(len(q)):
            q[j] = configurations[k, j]
        _place(world[0], world[1], q, memory[2], placed)
        own = _gap_of_arm(world, 2.0 * largest, memory)
        to_world = own if wanted != GAPS and own < 0.0 else _gap_to_world(world, largest, memory)
        gaps[k] = min(own, to_world)
        if wanted == FIRST and gaps[k] < 0.0:
            return k + 1
        if skips:
            smallest = min(smallest, gaps[k])
            # two parts may move towards each other
            free = min(own / 2.0, to_world) - (enough if enough >= 0.0 else max(smallest, 0.0) - enough)
            for m in range(k + 1, count):
                if free > 0.0 and gaps[m] != np.inf and _moved_less(positions[k], positions[m], free):
                    gaps[m] = np.inf
    return count
