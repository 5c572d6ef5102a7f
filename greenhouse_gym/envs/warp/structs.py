"""Structs of arrays on the device: the arm, the scenes, the draws of episodes, and the state of n simulations."""

from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from greenhouse_gym.envs.warp.geometry import geometry

IDLE, ACTING, FRESH = 0, 1, 2
"""Phases of a simulation during a launch: it does nothing, acts, or begins an episode."""

NO_CONTACT = 2**31 - 1
"""Contact of a simulation without one; others are encoded by `greenhouse_gym.envs.warp.contacts`."""


Half4 = wp.types.vector(4, wp.float16)
"""Node of a distance field: the distance, the distance without the nearest tomato, and the index of that tomato."""


@wp.struct
class Cells:
    """Cell lists, see `greenhouse_gym.envs.warp.cells.CellLists`."""

    start: wp.array(dtype=wp.int32)
    item: wp.array(dtype=wp.int32)
    side: wp.int32
    low: wp.float32


@lru_cache
def structs(real: Any) -> SimpleNamespace:
    """Return the structs for a type of real numbers; `Arm`, `Scenes` and `Draws` have the fields of their arrays."""
    g = geometry(real)
    vec3, mat3 = g.vec3, g.mat3

    @wp.struct
    class Arm:
        position: wp.array(dtype=vec3)
        rotation: wp.array(dtype=mat3)
        axis: wp.array(dtype=vec3)
        mass: wp.array(dtype=real)
        center: wp.array(dtype=vec3)
        inertia: wp.array(dtype=mat3)
        armature: wp.array(dtype=real)
        stiffness: wp.array(dtype=real)
        damping: wp.array(dtype=real)
        range_low: wp.array(dtype=real)
        range_high: wp.array(dtype=real)
        limit_stiffness: wp.array(dtype=real)
        limit_damping: wp.array(dtype=real)
        limit_weight: wp.array(dtype=real)
        impedance: wp.array2d(dtype=real)
        lower: wp.array(dtype=real)
        upper: wp.array(dtype=real)
        peak: wp.array(dtype=real)
        max_change: wp.array(dtype=real)
        part_link: wp.array(dtype=wp.int32)
        part_start: wp.array(dtype=vec3)
        part_end: wp.array(dtype=vec3)
        part_radius: wp.array(dtype=real)
        part_mask: wp.array(dtype=wp.int32)
        pairs: wp.array(dtype=wp.vec2i)
        probe_link: wp.array(dtype=wp.int32)
        probe_position: wp.array(dtype=vec3)
        probe_radius: wp.array(dtype=real)
        tip_position: vec3
        tip_axis: vec3
        timestep: real
        max_error: real

    @wp.struct
    class Scenes:
        base: wp.array(dtype=vec3)
        heading: wp.array(dtype=mat3)
        arm_rotation: wp.array(dtype=mat3)
        floor: wp.array(dtype=real)
        start: wp.array2d(dtype=real)
        fixtures: wp.array(dtype=wp.int32)
        tomato_first: wp.array(dtype=wp.int32)
        scene: wp.array(dtype=wp.int32)
        tomato: wp.array(dtype=wp.int32)
        shape: wp.array(dtype=wp.int32)
        target: wp.array(dtype=vec3)
        goal: wp.array(dtype=vec3)
        radius: wp.array(dtype=real)
        rating: wp.array(dtype=wp.int32)

    @wp.struct
    class Draws:
        cumulative: wp.array(dtype=wp.float32)
        first: wp.array(dtype=wp.int32)
        count: wp.array(dtype=wp.int32)
        row: wp.array(dtype=wp.int32)

    @wp.struct
    class State:
        """State of n simulations.

        Attributes:
            joints, velocities, command: (n, j) of the arm.
            start: (n, j) start of the next episode; NaN for that of its scene.
            wanted: (n,) tomato of the next episode; -1 draws one.
            seed, draws: (n,) seed, and number of episodes drawn with it.
            row: (n,) current tomato, a row of `Scenes`.
            steps, speed_limited, position_limited: (n,) counts of the episode.
            ended: (n,) 1 if the episode has ended.
            phase: (n,) `IDLE`, `ACTING` or `FRESH`.
            distance, effort: (n,) of the last step.
            contact: (n,) first contact of the action.
            start_contact: (n,) contact of the start, which counts in the first action.
            part_start, part_end: (n, substeps, g) ends of the parts after each physics step, in the scene.
            travel: (n, g) distance that a part moved in the action, at most.
            tip, axis: (n,) in the scene.
            probe: (n, k) in the scene.
        """

        joints: wp.array2d(dtype=real)
        velocities: wp.array2d(dtype=real)
        command: wp.array2d(dtype=real)
        start: wp.array2d(dtype=real)
        wanted: wp.array(dtype=wp.int32)
        seed: wp.array(dtype=wp.int32)
        draws: wp.array(dtype=wp.int32)
        row: wp.array(dtype=wp.int32)
        steps: wp.array(dtype=wp.int32)
        speed_limited: wp.array(dtype=wp.int32)
        position_limited: wp.array(dtype=wp.int32)
        ended: wp.array(dtype=wp.int32)
        phase: wp.array(dtype=wp.int32)
        distance: wp.array(dtype=real)
        effort: wp.array(dtype=real)
        contact: wp.array(dtype=wp.int32)
        start_contact: wp.array(dtype=wp.int32)
        part_start: wp.array3d(dtype=vec3)
        part_end: wp.array3d(dtype=vec3)
        travel: wp.array2d(dtype=real)
        tip: wp.array(dtype=vec3)
        axis: wp.array(dtype=vec3)
        probe: wp.array2d(dtype=vec3)

    return SimpleNamespace(**vars(g), Arm=Arm, Scenes=Scenes, Draws=Draws, State=State)
