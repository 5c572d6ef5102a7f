"""Distance fields on the device: their interpolation, and the distances around all tomatoes."""

from functools import lru_cache
from typing import Any

import warp as wp

from greenhouse_gym.envs.surroundings import POINTS
from greenhouse_gym.envs.warp.structs import Half4, structs
from greenhouse_gym.motion.distance_field import CELL, MAX_DISTANCE, ORIGIN, SHAPE


@lru_cache
def interpolation(real: Any) -> Any:
    """Return a function (fields, scene, point, ignored) of kernels, which interpolates a field linearly.

    Its result has the slopes along the axes, times the cell, and the distance, not capped, metres.
    """
    vec3, vec4 = structs(real).vec3, wp.types.vector(4, real)
    origin, cell, one = vec3(*ORIGIN), real(CELL), real(1.0)
    size_y, size_z, nodes = SHAPE[1], SHAPE[2], SHAPE[0] * SHAPE[1] * SHAPE[2]
    last_x, last_y, last_z = (real(size - 1 - 1e-5) for size in SHAPE)
    zero = real(0.0)

    @wp.func
    def interpolate(fields: wp.array(dtype=Half4), scene: wp.int32, point: vec3, ignored: wp.float16):
        position = (point - origin) / cell
        inside = vec3(
            wp.clamp(position[0], zero, last_x),
            wp.clamp(position[1], zero, last_y),
            wp.clamp(position[2], zero, last_z),
        )
        x = int(inside[0])
        y = int(inside[1])
        z = int(inside[2])
        fraction = inside - vec3(real(x), real(y), real(z))
        value = real(0.0)
        slope = vec3()
        for dx in range(2):
            for dy in range(2):
                for dz in range(2):
                    node = fields[scene * nodes + ((x + dx) * size_y + y + dy) * size_z + z + dz]
                    v = real(wp.where(node[2] == ignored, node[1], node[0]))
                    wx = wp.where(dx == 1, fraction[0], one - fraction[0])
                    wy = wp.where(dy == 1, fraction[1], one - fraction[1])
                    wz = wp.where(dz == 1, fraction[2], one - fraction[2])
                    value += v * wx * wy * wz
                    slope += v * vec3(
                        real(2 * dx - 1) * wy * wz, real(2 * dy - 1) * wx * wz, real(2 * dz - 1) * wx * wy
                    )
        return vec4(slope[0], slope[1], slope[2], value + cell * wp.length(position - inside))

    return interpolate


@lru_cache
def survey_kernel(real: Any) -> wp.Kernel:
    """Return the kernel of a precision."""
    t = structs(real)
    vec3, Scenes = t.vec3, t.Scenes
    interpolate, far, candidates = interpolation(real), real(MAX_DISTANCE), POINTS.shape[1]

    @wp.kernel(module="unique", enable_backward=False)
    def survey(
        scenes: Scenes, fields: wp.array(dtype=Half4), points: wp.array2d(dtype=vec3), out: wp.array2d(dtype=wp.float32)
    ):
        """Compute the distances (t, numbers) around each tomato, see `surroundings`."""
        row, k = wp.tid()
        ignored = wp.float16(float(scenes.tomato[row]))
        nearest = far
        for c in range(candidates):
            found = interpolate(fields, scenes.scene[row], scenes.target[row] + points[k, c], ignored)
            nearest = wp.min(nearest, found[3])
        out[row, k] = wp.float32(nearest)

    return survey


def distances_around(placements: Any, fields: Any, real: Any, device: Any) -> Any:
    """Return the distances (t, numbers) around all t tomatoes, a Warp array of float32, metres.

    Args:
        placements: Struct `Scenes` of the scenes.
        fields: Nodes of their distance fields.
        real: Type of real numbers.
        device: The device.
    """
    points = wp.array(POINTS, dtype=structs(real).vec3, device=device)
    out = wp.empty((len(placements.tomato), len(POINTS)), dtype=wp.float32, device=device)
    wp.launch(survey_kernel(real), out.shape, [placements, fields, points, out], device=device)
    return out
