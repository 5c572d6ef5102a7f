"""Scenes of a split on a device, shared by the environments of a process."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from greenhouse_gym.envs.episodes import EpisodeSampler
from greenhouse_gym.envs.warp.bank import SceneArrays, bank_of
from greenhouse_gym.envs.warp.cells import cell_lists
from greenhouse_gym.envs.warp.runtime import struct_of
from greenhouse_gym.envs.warp.structs import Cells, Half4, structs
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.motion.distance_field import SHAPE
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import DIFFICULTIES, Scene, SceneBank

BYTES_PER_SCENE = 9 * math.prod(SHAPE)
"""Approximate memory of a scene, most of it for its distance field."""

CACHED = 4
"""Number of splits that stay on a device without an environment."""


@dataclass(frozen=True, eq=False)
class DeviceBank:
    """Scenes of a split.

    Attributes:
        scenes: The scenes.
        index: Index of each scene by name.
        arrays: Placements and tomatoes as arrays.
        placements: The same on the device.
        shapes: Shapes that the arm may touch, on the device.
        cells: Cell lists of these shapes, on the device.
        fields: Nodes of the distance fields, on the device.
    """

    scenes: list[Scene]
    index: dict[str, int]
    arrays: SceneArrays
    placements: Any
    shapes: Any
    cells: Any
    fields: Any

    def index_of(self, scene: str | Scene, split: str) -> int:
        """Return the index of a scene.

        Raises:
            InvalidValueError: It does not belong to the split.
        """
        name = scene if isinstance(scene, str) else scene.name
        index = self.index.get(name)
        if index is None or not (isinstance(scene, str) or self.scenes[index] is scene):
            raise InvalidValueError(
                f'scene {name!r} is not in split {split!r}, whose scenes backend="warp" holds on the device: make the '
                "environment with its bank and split"
            )
        return index


def device_bank(sampler: EpisodeSampler, physics: str, reach: float, device: str, real: Any) -> DeviceBank:
    """Return the scenes of a sampler's split on a device.

    Args:
        sampler: The sampler.
        physics: "reconstruction" or "truth".
        reach: Reach of the arm, metres.
        device: Name of the device.
        real: Type of real numbers.
    """
    return _device_bank(sampler.bank, sampler.split, sampler.robot, physics, reach, device, real)


@lru_cache(maxsize=CACHED)
def _device_bank(
    bank: SceneBank, split: str, robot: Robot, physics: str, reach: float, device: str, real: Any
) -> DeviceBank:
    scenes = [bank.scene(name) for name in bank.names(split)]
    whole = bank_of(scenes, EpisodeSampler(bank, split, robot, DIFFICULTIES), physics)
    types, numbers = structs(real), whole.fields.view(np.float16).reshape(-1, 4)
    numbers[:, 2] = whole.fields["tomato"].reshape(-1)
    return DeviceBank(
        scenes,
        {scene.name: i for i, scene in enumerate(scenes)},
        whole.scenes,
        struct_of(types.Scenes, whole.scenes, device),
        struct_of(types.Shapes, whole.shapes, device),
        struct_of(Cells, cell_lists(whole.shapes, whole.scenes.base, reach), device),
        wp.array(numbers, dtype=Half4, device=device),
    )
