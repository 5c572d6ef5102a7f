"""An agent that has no scan: what it knows of the plants its own camera has shown it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.careful import CAREFUL_DEPTHS
from greenhouse_gym.agents.watchful import WatchfulAgent
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import base_position
from greenhouse_gym.scene.occupancy import REACH, UNKNOWN, OccupancyGrid

_VOXEL = 0.05  # metres


class ExploringAgent:
    """Does what `WatchfulAgent` does, in a scene that holds the target alone and of which nothing was seen.

    It is told the target's place and radius; of the scan it asks nothing else. What it saves a robot is the scan, and
    what it costs are looks around before it reaches. Its images are those of ``observation="depth"``, so that a policy
    for that observation can learn from it; and where nothing was seen, it goes as deep as `CarefulAgent` at once.
    """

    name = "exploring"
    env_options: Mapping[str, Any] = MappingProxyType({"observation": "depth"})

    def __init__(self) -> None:
        self._watchful = WatchfulAgent(depth=CAREFUL_DEPTHS[0])

    @property
    def status(self) -> str:
        """What `WatchfulAgent` says of its ways."""
        return self._watchful.status

    def reset(self, problem: Problem) -> None:
        """Forget what was seen."""
        scene = unscanned(problem.scene, problem.target, problem.robot)
        self._watchful.reset(replace(problem, scene=scene, target=0))

    def act(self, observation: object) -> npt.NDArray[np.float32]:
        """The next action, (joints,)."""
        return self._watchful.act(observation)


def unscanned(scene: Scene, target: int, robot: Robot) -> Scene:
    """What is known of a scene without a scan: its target, where the arm stands, and that nothing was seen."""
    shoulder = base_position(scene, robot) + [0.0, 0.0, robot.shoulder_height]
    shape = (int(np.ceil(2 * REACH / _VOXEL)),) * 3
    seen = OccupancyGrid.from_states(np.full(shape, UNKNOWN, dtype=np.uint8), shoulder - REACH, _VOXEL)
    known = {"tomatoes": (scene.tomatoes[target],), "stems": (), "clutter": (), "targets": (), "truth": None}
    return scene.model_copy(update={**known, "occupancy": seen})
