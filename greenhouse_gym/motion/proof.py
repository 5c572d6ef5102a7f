"""Continuous collision checking: fine motions with fewer calls of MuJoCo, and with the same results.

Where the arm is far from everything, one distance query covers more than one configuration: no point of the arm moves
farther than the joints' reaches allow, so an obstacle at a distance cannot be touched at nearby configurations (as in
Schwarzer, Saha, Latombe: Adaptive Dynamic Collision Checking for Single and Multiple Articulated Robots in Complex
Environments, 2005). Kernels estimate these distances, so that MuJoCo is asked first where the arm is farthest from
everything, and few of its queries prove a motion.
"""

from __future__ import annotations

import copy
from collections.abc import Collection
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import (
    COLLISION_PAIRS,
    LEAVES,
    CollisionChecker,
    Leaves,
    halving_order,
    planning_model,
)
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.scene.mjcf import CompiledScene

if TYPE_CHECKING:
    from greenhouse_gym.motion.collision_kernels import World

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
    """A `CollisionChecker` with the same results and counts that is about twice as fast along fine motions.

    ``checks`` counts the configurations decided, including those covered by a distance query nearby.
    """

    @cached_property
    def search(self) -> CollisionChecker:
        """The fastest checker of the same model: what it finds free is to be proven by this one."""
        from greenhouse_gym.motion.kernel_checker import search_checker

        return search_checker(self.model, self._known_reaches)

    @cached_property
    def _wide_model(self) -> mujoco.MjModel:
        model = copy.copy(self.model)
        model.geom_margin += LOOK_AHEAD / 2  # those of the two geoms of a pair are added
        model.body_margin += LOOK_AHEAD / 2
        model.pair_margin += LOOK_AHEAD
        return model

    @cached_property
    def _wide_world(self) -> World | None:
        from greenhouse_gym.motion.kernel_checker import kernel_world

        return kernel_world(self._wide_model)

    def inside_is_free(self, start: Array, end: Array, resolution: float) -> bool:
        """Return whether a motion between free ends is free."""
        if resolution > LOOK_AHEAD / 2:
            return super().inside_is_free(start, end, resolution)
        if tuple(start) > tuple(end):
            start, end = end, start
        motion = end - start
        fractions = halving_order(self._steps(motion, resolution))[:, 0]
        moved = float(self.reaches @ np.abs(motion)) * fractions
        configurations = start + fractions[:, None] * motion
        expected = self._expected_radii(configurations)
        far = expected > resolution
        # the farthest from obstacles first, unless a collision is expected
        undecided = np.argsort(-expected, kind="stable") if (expected > 0).all() else np.arange(len(expected))
        collision = None
        while len(undecided):
            k = int(undecided[0])
            radius = self._free_radius(configurations[k], bool(far[k]))
            undecided = undecided[1:]
            if radius is None:
                collision, undecided = k, np.sort(undecided[undecided < k])  # is there an earlier one?
            else:
                undecided = undecided[np.abs(moved[undecided] - moved[k]) >= radius]
        self.checks += len(fractions) if collision is None else collision + 1
        return collision is None

    def _expected_radii(self, configurations: Array) -> Array:
        """Estimate (k,) results of `_free_radius` by kernels, 0 or less for collisions; without kernels its maximum."""
        gaps = np.zeros(len(configurations))
        if self._wide_world is not None:
            from greenhouse_gym.motion.clearance_kernels import smallest_gaps

            smallest_gaps(self._wide_world, configurations, np.inf, -np.inf, gaps)
        return LOOK_AHEAD + gaps

    def _free_radius(self, configuration: Array, far: bool = True) -> float | None:
        """Return how far the points of the arm may move without a contact, metres; None if there is one already.

        Without ``far``, no distance is measured and the radius is 0.
        """
        model, data = self.model, self._data
        self._qpos[:] = configuration
        mujoco.mj_kinematics(model, data)
        if far:
            mujoco.mj_collision(self._wide_model, data)
            if data.ncon == 0:
                return LOOK_AHEAD - _TOLERANCE
            contacts = data.contact
            slack = LOOK_AHEAD + float((contacts.dist - contacts.includemargin).min())
            if slack > _TOLERANCE:
                return slack - _TOLERANCE
        mujoco.mj_collision(model, data)
        return None if data.ncon else 0.0
