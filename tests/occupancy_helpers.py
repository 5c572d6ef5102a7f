"""Scenes that say what was seen of them."""

from __future__ import annotations

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

LOW, HIGH, VOXEL = np.array([-1.35, -1.35, 0.0]), np.array([1.35, 1.35, 2.45]), 0.05


def known_where(scene: Scene, seen: float | None, aisle: float = -1.35) -> Scene:
    """The scene, seen up to a height; what is above, and farther from the aisle than given, is unknown."""
    shape = np.rint((HIGH - LOW) / VOXEL).astype(int)
    states = np.full(shape, FREE, dtype=np.uint8)
    if seen is not None:
        states[round((aisle - LOW[0]) / VOXEL) :, :, round(seen / VOXEL) :] = UNKNOWN
    return scene.model_copy(update={"occupancy": OccupancyGrid.from_states(states, LOW, VOXEL)})


def with_surface_at(scene: Scene, places: Array) -> Scene:
    """A scene whose scan saw a surface in the voxels of places (n, 3), and all else empty."""
    space = known_where(scene, None).occupancy
    assert space is not None
    states = space.states.copy()
    cells = np.floor((places - space.origin) / space.voxel).astype(int)
    states[tuple(cells.T)] = OCCUPIED
    return scene.model_copy(update={"occupancy": OccupancyGrid.from_states(states, space.origin, space.voxel)})
