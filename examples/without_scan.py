"""Reach without a scan: everything except the target is unknown until the wrist camera has observed it.

greenhouse-gym compare examples/without_scan.py:ExploringAgent watchful --track truth --episodes 20
"""

from dataclasses import replace

import numpy as np

from greenhouse_gym.agents import WatchfulAgent
from greenhouse_gym.scene.mjcf import base_position
from greenhouse_gym.scene.occupancy import REACH, UNKNOWN, OccupancyGrid

VOXEL = 0.05  # metres


class ExploringAgent(WatchfulAgent):
    name = "exploring"

    def __init__(self):
        super().__init__(depth=0.1, image=(64, 48))

    def reset(self, problem):
        scene, arm = problem.scene, problem.robot
        shoulder = base_position(scene, arm) + [0.0, 0.0, arm.shoulder_height]
        shape = (int(np.ceil(2 * REACH / VOXEL)),) * 3
        unknown = OccupancyGrid.from_states(np.full(shape, UNKNOWN, np.uint8), shoulder - REACH, VOXEL)
        target = (scene.tomatoes[problem.target],)
        nothing = {"stems": (), "clutter": (), "targets": (), "truth": None}
        bare = scene.model_copy(update={**nothing, "tomatoes": target, "occupancy": unknown})
        super().reset(replace(problem, scene=bare, target=0))
