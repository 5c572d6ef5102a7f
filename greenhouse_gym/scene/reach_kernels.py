"""Search for what an arm can reach while its joints turn a little."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import inlined, kernel

Floats = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]
Ids = npt.NDArray[np.int64]
Ids32 = npt.NDArray[np.int32]
Bools = npt.NDArray[np.bool_]

_FARTHER = 0.15
"""How far beyond the reach of a sphere a tree is searched, so that later calls need not, metres."""


@inlined
def _place(position, rotation, point, middle):
    """Write a point of a body in the world frame."""
    for k in range(3):
        middle[k] = position[k]
        for m in range(3):
            middle[k] += rotation[3 * k + m] * point[m]


@inlined
def _travel(middle, levers, slides, anchors, turns):
    """Return how far a point can move: by its distance from each joint, which the joints in between make larger."""
    travel, grown = 0.0, 0.0
    for j in range(len(turns) - 1, -1, -1):
        squared = 0.0
        for k in range(3):
            squared += (middle[k] - anchors[j, k]) ** 2
        lever = levers[j] if slides[j] else min(np.sqrt(squared) + grown, levers[j])
        travel += turns[j] * lever
        grown += turns[j] * levers[j]
    return travel


@kernel(
    "void(f8[:,:,:], f8[:,:,:], i8[::1], f8[:,::1], f8[::1], f8[:,::1], b1[::1], f8[:,:,:], f8[:,::1], f8[:,:,:,::1],"
    " b1[:,::1])",
    writes=("far",),
)
def mark_far(
    positions: Floats,
    rotations: Floats,
    bodies: Ids,
    points: Floats,
    radii: Floats,
    levers: Floats,
    slides: Bools,
    anchors: Floats,
    turns: Floats,
    boxes: Floats,
    far: Bools,
) -> None:
    """Mark the boxes that stay out of reach of each of n arms.

    Args:
        positions: (n, b, 3) positions of the bodies of the arms, metres.
        rotations: (n, b, 9) their rotations.
        bodies: (s,) the body of each of s spheres.
        points: (s, 3) middles of the spheres in the frames of these bodies, metres.
        radii: (s,) radii of the spheres, metres.
        levers: (s, j) maximum motion of the middles with each joint, metres per radian or metre, in any configuration.
        slides: (j,) mask of the joints that slide, whose levers are 1.
        anchors: (n, j, 3) anchors of the joints, metres.
        turns: (n, j) how far each joint turns at most, radians or metres.
        boxes: (n, 2, m, 3) lower and upper corners of the boxes, metres.
        far: (n, m) result.
    """
    spheres = len(bodies)
    middles, reach = np.empty((spheres, 3)), np.empty(spheres)
    for i in range(len(positions)):
        for s in range(spheres):
            b = bodies[s]
            _place(positions[i, b], rotations[i, b], points[s], middles[s])
            reach[s] = radii[s] + _travel(middles[s], levers[s], slides, anchors[i], turns[i])
        for m in range(boxes.shape[2]):
            far[i, m] = True
            for s in range(spheres):
                squared = 0.0
                for k in range(3):
                    apart = max(boxes[i, 0, m, k] - middles[s, k], middles[s, k] - boxes[i, 1, m, k], 0.0)
                    squared += apart * apart
                if squared <= reach[s] * reach[s]:
                    far[i, m] = False
                    break


@inlined
def _clearance(point, boxes, after, size, limit):
    """Return the distance of a point from the nearest leaf of a tree, or the limit if that is less, metres."""
    nearest, node = limit * limit, 0
    while node < size:
        squared = 0.0
        for k in range(3):
            apart = max(boxes[node, k] - point[k], point[k] - boxes[node, 3 + k], 0.0)
            squared += apart * apart
        if squared >= nearest:
            node = after[node]
        elif after[node] == node + 1:
            nearest, node = squared, node + 1
        else:
            node += 1
    return np.sqrt(nearest)


@kernel(
    "void(f8[:,:,:], f8[:,:,:], i8[::1], f8[:,::1], f8[::1], f8[:,::1], b1[::1], f8[:,:,:], f8[:,::1],"
    " f4[:,:,::1], i4[:,::1], i8[::1], f8[:,:,::1], f8[:,::1], b1[:,::1])",
    writes=("centers", "clear", "near"),
)
def mark_near(
    positions: Floats,
    rotations: Floats,
    bodies: Ids,
    points: Floats,
    radii: Floats,
    levers: Floats,
    slides: Bools,
    anchors: Floats,
    turns: Floats,
    boxes: Floats32,
    after: Ids32,
    sizes: Ids,
    centers: Floats,
    clear: Floats,
    near: Bools,
) -> None:
    """Mark the bodies of each of n arms that can reach a leaf of a tree of boxes.

    Args:
        positions: (n, b, 3) positions of the bodies of the arms, metres.
        rotations: (n, b, 9) their rotations.
        bodies: (s,) the body of each of s spheres.
        points: (s, 3) middles of the spheres in the frames of these bodies, metres.
        radii: (s,) radii of the spheres, metres.
        levers: (s, j) maximum motion of the middles with each joint, metres per radian or metre, in any configuration.
        slides: (j,) mask of the joints that slide, whose levers are 1.
        anchors: (n, j, 3) anchors of the joints, metres.
        turns: (n, j) how far each joint turns at most, radians or metres.
        boxes: (n, m, 6) lower and upper corners of the nodes of each tree in depth-first order, metres.
        after: (n, m) node that follows the subtree of each node.
        sizes: (n,) numbers of nodes.
        centers: (n, s, 3) memory of calls with the same trees: where the trees were searched, metres,
        clear: (n, s) and how far from there they have no leaf, metres; at first negative.
        near: (n, bodies) result.
    """
    middle, joints = np.empty(3), turns.shape[1]
    for i in range(len(positions)):
        for b in range(near.shape[1]):
            near[i, b] = False
        for s in range(len(bodies)):
            b = bodies[s]
            if near[i, b]:
                continue
            _place(positions[i, b], rotations[i, b], points[s], middle)
            squared, farthest = 0.0, 0.0
            for k in range(3):
                squared += (middle[k] - centers[i, s, k]) ** 2
            for j in range(joints):
                farthest += turns[i, j] * levers[s, j]
            room = clear[i, s] - np.sqrt(squared) - radii[s]
            if farthest < room:
                continue
            travel = _travel(middle, levers[s], slides, anchors[i], turns[i])
            if travel < room:
                continue
            for k in range(3):
                centers[i, s, k] = middle[k]
            reach = radii[s] + travel
            clear[i, s] = _clearance(middle, boxes[i], after[i], sizes[i], reach + _FARTHER)
            near[i, b] = reach >= clear[i, s]


@kernel(
    "i8(i4[:,::1], f8[:,::1], b1[::1], f4[:,::1], i4[::1], i4[::1])",
    writes=("boxes", "after", "source"),
)
def pack_tree(child: Ids32, aabb: Floats, chosen: Bools, boxes: Floats32, after: Ids32, source: Ids32) -> int:
    """Write a tree over some leaves of a larger one in depth-first order; return its number of nodes.

    Args:
        child: (m, 2) children of the nodes in depth-first order; -1 for leaves.
        aabb: (m, 6) centers and half sizes of the boxes of the nodes, metres.
        chosen: (m,) mask of the leaves to keep.
        boxes: (k, 6) result: lower and upper corners, rounded outward.
        after: (k,) result: node that follows the subtree of each node.
        source: (k,) result: each node in the larger tree.
    """
    count = len(child)
    sizes, corners = np.zeros(count, np.int64), np.empty((count, 6))
    for node in range(count - 1, -1, -1):
        left, right = child[node, 0], child[node, 1]
        if left < 0:
            sizes[node] = 1 if chosen[node] else 0
            for k in range(3):
                corners[node, k] = aabb[node, k] - aabb[node, 3 + k]
                corners[node, 3 + k] = aabb[node, k] + aabb[node, 3 + k]
            continue
        sizes[node] = sizes[left] + sizes[right]
        if sizes[left] > 0 and sizes[right] > 0:
            sizes[node] += 1
        # a part without leaves counts as its sibling
        one = left if sizes[left] > 0 else right
        other = right if sizes[right] > 0 else left
        for k in range(3):
            corners[node, k] = min(corners[one, k], corners[other, k])
            corners[node, 3 + k] = max(corners[one, 3 + k], corners[other, 3 + k])
    place, done = np.zeros(count, np.int64), 0
    for node in range(count):
        if sizes[node] == 0:
            continue
        left, right, at = child[node, 0], child[node, 1], place[node]
        both = left >= 0 and sizes[left] > 0 and sizes[right] > 0
        if left < 0 or both:
            for k in range(3):
                boxes[at, k] = np.nextafter(np.float32(corners[node, k]), np.float32(-np.inf))
                boxes[at, 3 + k] = np.nextafter(np.float32(corners[node, 3 + k]), np.float32(np.inf))
            after[at], source[at] = at + sizes[node], node
            done += 1
        if left >= 0:  # a node with one part gives it its own place
            place[left] = at + 1 if both else at
            place[right] = at + 1 + sizes[left] if both else at
    return done
