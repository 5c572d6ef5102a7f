"""Hide the world from the links of arms that cannot reach it from MuJoCo's search for contacts.

In each physics step MuJoCo searches the tree over the geoms of the world for each link of an arm. A link that is
farther from all of them than it moves in an action touches none, so the collision masks of the bodies leave out this
pair meanwhile. Contacts stay equal bit for bit as long as the joints turn no farther than was foreseen, which the
steppers check.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.state import Bools, Ids
from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.arm_spheres import arm_spheres
from greenhouse_gym.scene.world_tree import BoxTree

_GAP = 1e-3  # metres: for rounding
_ALL_BITS = 0x7FFFFFFF


class HiddenWorlds:
    """The worlds of n models, each hidden from the links of its arm that are far from it.

    Args:
        models: The models, whose worlds are shown.
        joints: Number of the arm's joints.

    Attributes:
        frames: The bodies of the arm.
    """

    def __init__(self, models: Sequence[mujoco.MjModel], joints: int):
        first, count = models[0], len(models)
        arm = arm_spheres(first, joints)
        self._arm, self.frames = arm._replace(radii=arm.radii + _GAP), arm.frames
        self._types, self._affinities = _masks(models)
        self._shown = first.body_contype.copy(), first.body_conaffinity.copy()
        types, affinities = self._shown
        self._collide = ((types & affinities[0]) | (types[0] & affinities)) != 0
        free = _ALL_BITS & ~int(np.bitwise_or.reduce(types | affinities))
        self._bit = free & -free  # with it a link is found by the world, and nothing else changes
        nodes = int(first.body_bvhnum[0]) + 1
        self._boxes, self._after = np.zeros((count, nodes, 6), np.float32), np.zeros((count, nodes), np.int32)
        self._sizes = np.zeros(count, dtype=np.int64)
        self._centers, self._clear = np.zeros((count, len(arm.radii), 3)), np.full((count, len(arm.radii)), -1.0)
        self._hidden = np.zeros(count, dtype=np.bool_)
        self._near = np.ones((count, first.nbody), dtype=np.bool_)

    def load(self, i: int, tree: BoxTree) -> None:
        """Search the tree of another world for a model."""
        size = self._sizes[i] = len(tree.after)
        self._boxes[i, :size], self._after[i, :size] = tree
        self._clear[i] = -1.0

    def copied(self, models: Sequence[mujoco.MjModel]) -> HiddenWorlds:
        """Return the same for copies of the models."""
        twin, longest = copy.copy(self), int(self._sizes.max())
        twin._types, twin._affinities = _masks(models)
        twin._boxes, twin._after = np.zeros_like(self._boxes), np.zeros_like(self._after)
        twin._boxes[:, :longest], twin._after[:, :longest] = self._boxes[:, :longest], self._after[:, :longest]
        twin._sizes, twin._hidden, twin._near = self._sizes.copy(), self._hidden.copy(), self._near.copy()
        twin._centers, twin._clear = self._centers.copy(), self._clear.copy()
        return twin

    def hide(self, positions: Array, rotations: Array, xanchor: Array, turns: Array) -> None:
        """Hide the worlds until the next `show` or `hide`.

        Args:
            positions: (n, b, 3) positions of the bodies of the arms, metres.
            rotations: (n, b, 9) their rotations.
            xanchor: (n, j, 3) points on the joint axes, metres.
            turns: (n, j) how far each joint turns at most, radians or metres.
        """
        from greenhouse_gym.scene.reach_kernels import mark_near

        if not self._bit:
            return
        near = np.empty_like(self._near)
        mark_near(
            positions, rotations, *self._arm, xanchor, turns,
            self._boxes, self._after, self._sizes, self._centers, self._clear, near,
        )  # fmt: skip
        near &= self._collide
        changed = np.flatnonzero((near != self._near).any(axis=1) | ~self._hidden)
        if len(changed):
            types = np.where(near[changed], self._shown[0] | self._bit, self._shown[0])
            types[:, 0] = 0
            for i, row in zip(changed.tolist(), types, strict=True):
                self._types[i][:], self._affinities[i][0] = row, self._bit
        self._near, self._hidden[:] = near, True

    def show(self, ids: Ids) -> None:
        """Show the worlds of some models."""
        types, affinities = self._shown
        for i in ids[self._hidden[ids]].tolist():
            self._types[i][:], self._affinities[i][0] = types, affinities[0]
        self._hidden[ids] = False


def _masks(models: Sequence[mujoco.MjModel]) -> tuple[list[npt.NDArray[np.int32]], list[npt.NDArray[np.int32]]]:
    """Return the live collision masks of the bodies of each model."""
    return [model.body_contype for model in models], [model.body_conaffinity for model in models]


LAG = 0.005
"""How much farther an arm turns than to its command because it stops late, radians or metres."""


def foreseen(qpos: Array, command: Array, speed: Array, interval: float) -> Array:
    """Return how far joints turn at most (n, j) while servos move them from the old commands to the new ones."""
    return np.maximum(np.abs(command - qpos), np.abs(command + speed * interval - qpos)) + LAG


def beyond(recorded: Array, end: Array, start: Array, turns: Array) -> Bools:
    """Return a mask (n,) of arms that have turned farther than foreseen.

    Args:
        recorded: (n, j, k) joint positions during an action.
        end: (n, j) those at its end.
        start: (n, j) those at its start.
        turns: (n, j) how far each joint was to turn at most.
    """
    farthest = np.maximum(np.abs(recorded - start[..., None]).max(axis=2), np.abs(end - start))
    return np.asarray((farthest > turns).any(axis=1))
