"""Search for the boxes that an arm cannot reach while its joints turn a little."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import kernel

Floats = npt.NDArray[np.float64]


@kernel(
    "void(f8[:,:,::1], f8[:,:,::1], i8[::1], f8[::1], f8[::1], f8[:,::1], f8[:,:,::1], f8[:,::1], f8[:,:,:,::1],"
    " b1[:,::1])",
    writes=("far",),
)
def mark_far(
    positions: Floats,
    rotations: Floats,
    geoms: npt.NDArray[np.int64],
    offsets: Floats,
    radii: Floats,
    levers: Floats,
    anchors: Floats,
    turns: Floats,
    boxes: Floats,
    far: npt.NDArray[np.bool_],
) -> None:
    """Mark the boxes that stay out of reach of each of n arms.

    Args:
        positions: (n, g, 3) positions of the geoms of the arms, metres.
        rotations: (n, g, 9) their rotations.
        geoms: (s,) the geom in each of s spheres.
        offsets: (s,) offsets of the middles of the spheres along the z axes of their geoms, metres.
        radii: (s,) radii of the spheres, metres.
        levers: (s, j) maximum motion of the middles with each joint, metres per radian or metre, in any configuration.
        anchors: (n, j, 3) anchors of the joints, metres.
        turns: (n, j) how far each joint turns at most, radians or metres.
        boxes: (n, 2, b, 3) lower and upper corners of the boxes, metres.
        far: (n, b) result.
    """
    count, spheres, joints = positions.shape[0], len(geoms), anchors.shape[1]
    middles, reach = np.empty((spheres, 3)), np.empty(spheres)
    for i in range(count):
        for s in range(spheres):
            for k in range(3):
                middles[s, k] = positions[i, geoms[s], k] + offsets[s] * rotations[i, geoms[s], 3 * k + 2]
            # a sphere moves by its distance from a joint, which the joints in between make larger
            travel, grown = 0.0, 0.0
            for j in range(joints - 1, -1, -1):
                squared = 0.0
                for k in range(3):
                    squared += (middles[s, k] - anchors[i, j, k]) ** 2
                travel += turns[i, j] * min(np.sqrt(squared) + grown, levers[s, j])
                grown += turns[i, j] * levers[s, j]
            reach[s] = radii[s] + travel
        for b in range(boxes.shape[2]):
            far[i, b] = True
            for s in range(spheres):
                squared = 0.0
                for k in range(3):
                    apart = max(boxes[i, 0, b, k] - middles[s, k], middles[s, k] - boxes[i, 1, b, k], 0.0)
                    squared += apart * apart
                if squared <= reach[s] * reach[s]:
                    far[i, b] = False
                    break
