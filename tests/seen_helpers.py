"""Scenes that say what was seen of them."""

from __future__ import annotations

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.occupancy import EMPTY, SURFACE, UNSEEN, SeenSpace

LOW, HIGH, VOXEL = np.array([-1.35, -1.35, 0.0]), np.array([1.35, 1.35, 2.45]), 0.05


def seen_where(scene: Scene, seen: float | None, aisle: float = -1.35) -> Scene:
    """The scene, seen up to a height; what is above, and farther from the aisle than given, is unseen."""
    shape = np.rint((HIGH - LOW) / VOXEL).astype(int)
    states = np.full(shape, EMPTY, dtype=np.uint8)
    if seen is not None:
        states[round((aisle - LOW[0]) / VOXEL) :, :, round(seen / VOXEL) :] = UNSEEN
    return scene.model_copy(update={"seen": SeenSpace.of(states, LOW, VOXEL)})


def with_surface_at(scene: Scene, places: Array) -> Scene:
    """A scene whose scan saw a surface in the voxels of places (n, 3), and all else empty."""
    space = seen_where(scene, None).seen
    assert space is not None
    states = space.states.copy()
    cells = np.floor((places - space.origin) / space.voxel).astype(int)
    states[tuple(cells.T)] = SURFACE
    return scene.model_copy(update={"seen": SeenSpace.of(states, space.origin, space.voxel)})
