"""Scenes of a split on a device, shared by the environments of a process."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from greenhouse_gym.envs.episodes import EpisodeSampler
from greenhouse_gym.envs.warp.bank import SceneArrays, ShapeArrays, bank_of
from greenhouse_gym.envs.warp.fields import COARSE_CELL, COARSE_COUNT, COARSE_UNIT, Half4, grid_kernels
from greenhouse_gym.envs.warp.runtime import BLOCK_SIZE, load_kernels, struct_of
from greenhouse_gym.envs.warp.structs import structs
from greenhouse_gym.motion.distance_field import CELL, MAX_DISTANCE, ORIGIN, SHAPE
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import DIFFICULTIES, Scene, SceneBank

BYTES_PER_SCENE = 8 * math.prod(SHAPE) + COARSE_COUNT**3
"""Memory of a scene's distance grids."""

CACHED = 4
"""Number of splits that stay on a device without an environment."""

_AT_ONCE = 16  # scenes whose grids are computed together


@dataclass(frozen=True, eq=False)
class DeviceBank:
    """Scenes of a split.

    Attributes:
        scenes: The scenes.
        index: Index of each scene by name.
        arrays: Placements and tomatoes as arrays.
        placements: The same on the device.
        shapes: Shapes that the arm may touch, on the device.
        grids: Distance grids on the device.
    """

    scenes: list[Scene]
    index: dict[str, int]
    arrays: SceneArrays
    placements: Any
    shapes: Any
    grids: Any


def device_bank(sampler: EpisodeSampler, physics: str, device: str, real: Any) -> DeviceBank:
    """Return the scenes of a sampler's split on a device.

    Args:
        sampler: The sampler.
        physics: "reconstruction" or "truth".
        device: Name of the device.
        real: Type of real numbers.
    """
    return _device_bank(sampler.bank, sampler.split, sampler.robot, physics, device, real)


@lru_cache(maxsize=CACHED)
def _device_bank(bank: SceneBank, split: str, robot: Robot, physics: str, device: str, real: Any) -> DeviceBank:
    scenes = [bank.scene(name) for name in bank.names(split)]
    whole = bank_of(scenes, EpisodeSampler(bank, split, robot, DIFFICULTIES), physics)
    types, count, placed = structs(real), len(scenes), whole.scenes
    fruit = np.bincount(placed.scene, minlength=count).astype(np.int32)
    upright, nothing = np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, dtype=np.int32)
    fine = _grid(
        whole.known, placed.fixtures, fruit, placed.base, placed.heading, ORIGIN, CELL, SHAPE, MAX_DISTANCE, device
    )
    low, limit = -COARSE_CELL * (COARSE_COUNT - 1) / 2, 255 * COARSE_UNIT
    around = _grid(
        whole.simulated,
        nothing,
        nothing,
        placed.base,
        upright,
        (low,) * 3,
        COARSE_CELL,
        (COARSE_COUNT,) * 3,
        limit,
        device,
    )
    grids = types.Grids()
    grids.fine, grids.coarse = fine, wp.empty(around.shape, dtype=wp.uint8, device=device)
    wp.launch(grid_kernels().coarsen, around.shape, [around, grids.coarse], device=device, block_dim=BLOCK_SIZE)
    return DeviceBank(
        scenes,
        {scene.name: i for i, scene in enumerate(scenes)},
        placed,
        struct_of(types.Scenes, placed, device),
        struct_of(types.Shapes, whole.simulated, device),
        grids,
    )


def _grid(
    shapes: ShapeArrays,
    skip: Any,
    fruit: Any,
    base: Any,
    rotation: Any,
    origin: Sequence[float],
    cell: float,
    size: Sequence[int],
    limit: float,
    device: str,
) -> Any:
    """Return grids of distances around the arms, one after the other.

    Args:
        shapes: Shapes of the scenes.
        skip: (s,) number of each scene's first shapes that are left out.
        fruit: (s,) number of tomatoes that follow these.
        base: (s, 3) positions of the arms, metres.
        rotation: (s, 3, 3) scene_from_grid.
        origin: First node from the arm's base, metres.
        cell: Distance between nodes, metres.
        size: Number of nodes along each axis, multiples of 8.
        limit: Largest distance that is stored, metres.
        device: Name of the device.
    """
    kernels, types, count, blocks = grid_kernels(), structs(wp.float32), len(skip), math.prod(size) // 512
    load_kernels(kernels, wp.get_device(device))
    table = struct_of(types.Shapes, shapes, device)
    arrays = [
        wp.array(values, dtype=kind, device=device)
        for values, kind in ((skip, wp.int32), (fruit, wp.int32), (base, types.vec3), (rotation, types.mat3))
    ]
    grid = wp.empty(count * math.prod(size), dtype=Half4, device=device)
    room = (min(_AT_ONCE, count) * blocks, 3 * max(int(shapes.count.max()), 1))
    rows, distances = (wp.empty(room, dtype=kind, device=device) for kind in (wp.int32, wp.float32))
    for first in range(0, count, _AT_ONCE):
        wp.launch(
            kernels.fill, (min(_AT_ONCE, count - first), blocks),
            [table, *arrays, first, types.vec3(*origin), cell, wp.vec3i(*size), limit, rows, distances, grid],
            device=device, block_dim=BLOCK_SIZE,
        )  # fmt: skip
    return grid
