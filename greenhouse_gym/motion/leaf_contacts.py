"""Pieces of leaves that an arm touches, and those that it brushes along a path."""

from __future__ import annotations

import threading
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import CollisionChecker, pass_through, set_margin, with_world_at_rest
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.motion.kernel_checker import kernel_world
from greenhouse_gym.motion.path import along_path
from greenhouse_gym.scene.mjcf import CompiledScene

_STEP = 0.01  # metres that any point of the arm moves between two configurations of a path


class LeafContacts:
    """Finder of the leaves that an arm touches; several threads may use it.

    Args:
        compiled: The scene with its arm.
        model: Its model, or a copy with the arm at another position.

    Attributes:
        count: Number of leaves of the scene.
    """

    def __init__(self, compiled: CompiledScene, model: mujoco.MjModel | None = None):
        model = compiled.model if model is None else model
        self._leaves, self._reaches, self._lock = compiled.leaf_geoms, arm_reaches(compiled.robot), threading.Lock()
        self.count = len(self._leaves)
        self._checker = CollisionChecker(leaves_alone(model, self._leaves), self._reaches)
        self._world = kernel_world(self._checker.model)

    def __deepcopy__(self, memo: dict[int, Any]) -> LeafContacts:
        return self

    def at(self, configurations: Array) -> npt.NDArray[np.int64]:
        """Return the leaves touched in some of the configurations (k, joints): indices into `Shapes.leaves`."""
        hit = np.zeros(self._checker.model.ngeom, dtype=np.bool_)
        if self._world is not None:
            from greenhouse_gym.motion.collision_kernels import GAPS, smallest_gaps

            q, gaps = np.ascontiguousarray(configurations, dtype=np.float64), np.empty(len(configurations))
            smallest_gaps(self._world, q, GAPS, 0.0, np.inf, gaps, hit)
        else:
            with self._lock:
                for configuration in configurations:
                    hit[[geom for pair in self._checker.contacts(configuration) for geom in pair]] = True
        return np.flatnonzero(hit[self._leaves])

    def brushed(self, path: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Return the leaves that are touched along a path (k, joints), as `at` does.

        It is checked at configurations between which no point of the arm moves farther than 1 cm.
        """
        return self.at(along_path(np.asarray(path, dtype=np.float64), self._reaches, _STEP))


def leaves_alone(model: mujoco.MjModel, leaves: npt.NDArray[np.int64]) -> mujoco.MjModel:
    """Copy a model so that the arm meets nothing except some geoms of the world, which have no margin."""
    alone = with_world_at_rest(model)
    pass_through(alone, np.setdiff1d(np.flatnonzero(alone.geom_bodyid == 0), leaves))
    alone.geom_contype[alone.geom_bodyid > 0] = 0  # leaves offer contacts to the arm, which offers none to itself
    set_margin(alone, leaves, 0.0)
    return alone
