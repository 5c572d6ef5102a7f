"""Continuous collision checking: fine motions with fewer calls of MuJoCo, and with the same results.

Where the arm is far from everything, one distance query covers more than one configuration: no point of the arm moves
farther than the joints' reaches allow, so an obstacle at a distance cannot be touched at nearby configurations (as in
Schwarzer, Saha, Latombe: Adaptive Dynamic Collision Checking for Single and Multiple Articulated Robots in Complex
Environments, 2005).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection
from functools import cached_property

import mujoco
import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import COLLISION_PAIRS, LEAVES, CollisionChecker, Leaves, planning_model
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.scene.mjcf import CompiledScene

LOOK_AHEAD = 0.04
"""Range of distance queries beyond the margins (m). With a larger one they would always report the adjacent link."""

_TOLERANCE = 1e-4  # metres: distances closer to the margin than this are decided by the exact model


def checker_of(
    compiled: CompiledScene, target: int, pairs: Collection[str] = COLLISION_PAIRS, leaves: Leaves = LEAVES[0]
) -> ProvingChecker:
    """Return the checker for planning a path to a target, with the usual margin; arguments as for `planning_model`."""
    model = planning_model(compiled, target, pairs=pairs, leaves=leaves)
    return ProvingChecker(model, arm_reaches(compiled.robot))


class ProvingChecker(CollisionChecker):
    """A `CollisionChecker` with the same results and counts that is faster along fine motions.

    Distances come from kernels, for arms that these can compute, otherwise from MuJoCo. It is MuJoCo that finds each
    configuration free that no such distance covers.

    ``checks`` counts the configurations decided, including those covered by a distance query nearby.
    """

    @cached_property
    def search(self) -> CollisionChecker:
        """Fastest checker of the same model; motions that it finds free must be proven by this one."""
        from greenhouse_gym.motion.kernel_checker import search_checker

        return search_checker(self.model, self._known_reaches)

    @cached_property
    def _wide_model(self) -> mujoco.MjModel:
        model = copy.copy(self.model)
        model.geom_margin += LOOK_AHEAD / 2  # those of the two geoms of a pair are added
        model.body_margin += LOOK_AHEAD / 2
        model.pair_margin += LOOK_AHEAD
        return model

    def _all_free(self, configurations: Array, resolution: float = math.inf) -> bool:
        from greenhouse_gym.motion.kernel_checker import FINE, KernelChecker, gaps_in

        if resolution > FINE:
            return super()._all_free(configurations)
        left, by_kernels = np.arange(len(configurations)), isinstance(self.search, KernelChecker)
        if isinstance(self.search, KernelChecker):
            left = np.flatnonzero(gaps_in(self.search.world, configurations, _TOLERANCE) < np.inf)
        while len(left):
            first, left = left[0], left[1:]
            radius = self._free_radius(configurations[first], by_kernels)
            if radius is None:
                self.checks += int(first) + 1
                return False
            if radius > 0.0:
                left = left[np.abs(configurations[left] - configurations[first]) @ self.reaches >= radius]
        self.checks += len(configurations)
        return True

    def _free_radius(self, configuration: Array, exact: bool = False) -> float | None:
        """Return how far the points of the arm may move without a contact, metres; None if there is one already.

        With ``exact``, the distance to the next contact is not measured, and the result is 0 or None.
        """
        model, data, gap = self.model, self._data, 0.0
        self._qpos[:] = configuration
        mujoco.mj_kinematics(model, data)
        if not exact:
            mujoco.mj_collision(self._wide_model, data)
            contacts = data.contact
            gap = LOOK_AHEAD + float((contacts.dist - contacts.includemargin).min(initial=0.0))
            if gap > _TOLERANCE:
                return gap - _TOLERANCE
        mujoco.mj_collision(model, data)
        return None if data.ncon else 0.0
