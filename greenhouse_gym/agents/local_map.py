"""Scan of a scene, updated with the observations of the wrist camera in an episode."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.occupancy_map import OccupancyMap
from greenhouse_gym.agents.viewpoints import NOTHING_OPAQUE, OpaqueCells
from greenhouse_gym.geometry import (
    Array,
    distance_to_nearest,
    distance_to_shapes,
    invert,
    transform,
)
from greenhouse_gym.geometry.shape_arrays import BOX
from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.motion.caution import unexplained_cells
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import arm_pose
from greenhouse_gym.scene.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, boxes_around_points

CLEARANCE = 0.002
"""Distance kept from points that the camera has observed, metres."""

_SHAPE, _SKIN = 0.001, 0.008  # metres: points so near to a shape of the scan, or to the target, belong to it
_AT_ARM = 0.01  # metres: points so near to the arm are no obstacle to a path that starts there
_EXAMINED = 0.8  # fraction of a box that the camera has to observe before its points replace the box
_MAX_BOXES = 20_000  # over observed points; voxels are larger where they would take more
_SPACING = 0.03  # metres between samples of unobserved space
_AISLE = (-0.5, -0.1)  # metres ahead of the base's axis: no true plant of 61 training and validation scenes is there
_AROUND_TARGET = 0.2  # metres: radius of the unobserved space around the target
_ARM_GAP, _TARGET_GAP = 0.02, 0.02  # metres: unobserved space so near to the arm or the target is left out


class LocalMap:
    """A scanned scene with the points that only the camera has observed; points are in the frame of the arm's base.

    The unknown space of the aisle behind the arm counts as free: no plants hang there, and an arm that starts bent back
    over it could hardly move otherwise.

    Args:
        problem: The episode.
        target: (3,) the target's center, metres.
        camera: The camera at the arm's wrist.
        unexplained: Whether unexplained occupied cells count as unobserved until the camera has looked at them.
        noisy: Whether the camera's images have the noise of a D435.

    Attributes:
        points: (n, 3) observed points near no shape of the scan, metres.
        points_at_boxes: (n, 3) observed points near boxes of clutter and no other shape of the scan, metres.
    """

    def __init__(
        self, problem: Problem, target: Array, camera: DepthCamera, unexplained: bool = False, noisy: bool = False
    ):
        self._scene_from_base = arm_pose(problem.scene, problem.robot)
        self._base_from_scene = invert(self._scene_from_base)
        scene = _with_free_aisle(problem.scene, self._base_from_scene)
        self._unexplained = unexplained_cells(scene) if unexplained and scene.occupancy is not None else None
        self.points: Array = np.zeros((0, 3))
        self.points_at_boxes: Array = np.zeros((0, 3))
        self._scene, self._arm, self._target = scene, arm_spheres(problem.robot), target
        self._tomato = scene.tomatoes[problem.target].shape
        self._map = OccupancyMap(self._arm, camera, target, self._tomato.radius, noisy)
        self._added = 0  # points of the map that were compared with the scan
        self._shapes = scene.arrays
        self._firm = self._shapes.select(np.flatnonzero(self._shapes.kinds != BOX))

    def add(self, depth: npt.NDArray[np.float32], joints: Array) -> bool:
        """Add an image (h, w), metres along the view, taken in a configuration (j,); return whether it adds points."""
        self._map.add(depth, joints)
        new, uncertainty = self._map.points[self._added :], self._map.uncertainty[self._added :]
        self._added += len(new)
        if len(new):
            points = transform(self._scene_from_base, new)
            tolerance = np.maximum(_SHAPE, uncertainty)
            reach = float(tolerance.max())
            explained = distance_to_nearest(points, self._shapes, reach) <= tolerance
            foreign = distance_to_shapes(points, [self._tomato])[:, 0] > _SKIN + uncertainty
            at_box = foreign & explained
            firm = distance_to_nearest(points[at_box], self._firm, reach)
            at_box[at_box] = firm > tolerance[at_box]
            self.points_at_boxes = np.concatenate([self.points_at_boxes, new[at_box]])
            new = new[foreign & ~explained]
            self.points = np.concatenate([self.points, new])
        return bool(len(new))

    def scene(self, command: Array, voxel: float, boxes: bool = True) -> Scene:
        """Return the scan's scene with clutter over the observed points that its shapes do not explain.

        Args:
            command: (j,) configuration of the arm; points at the arm are left out.
            voxel: Side of the voxels that cover the points, metres: small ones cover less free space. It is doubled
                while they are too many for a scene.
            boxes: Whether all boxes of the scan are kept. If not, boxes that the camera has examined are replaced by
                the points it has observed at them.
        """
        scene, points = self._scene, self._unexplained_points(boxes)
        points = points[~self._arm.near(points, command[None], _AT_ARM)]
        points = transform(self._scene_from_base, points)
        covered = boxes_around_points(points, voxel)
        while len(covered.kinds) > _MAX_BOXES:
            voxel *= 2
            covered = boxes_around_points(points, voxel)
        if not boxes:
            clutter = range(sum(scene.counts[:2]), scene.count)
            kept = np.array([not self._examined(k) for k in clutter], dtype=np.bool_)
            scene = scene.with_columns(scene.columns.with_clutter(kept), changed=("clutter",))
        return scene.with_space(covered).model_copy(update={"occupancy": self._occupancy()})

    def _unexplained_points(self, boxes: bool) -> Array:
        return self.points if boxes else np.concatenate([self.points, self.points_at_boxes])

    def _examined(self, index: int) -> bool:
        """Return whether the camera has observed most of a shape of the scan, which is a box."""
        kind, center, _, sizes, rotation = (array[index] for array in self._shapes)
        if kind != BOX:
            return False
        along = [np.linspace(-1, 1, 2 + int(2 * half / _SPACING)) * half for half in sizes]
        inside = np.stack(np.meshgrid(*along), axis=-1).reshape(-1, 3) @ rotation.T + center
        return bool(self._map.observed(transform(self._base_from_scene, inside)).mean() > _EXAMINED)

    def blocked(self, configurations: Array, boxes: bool = True) -> bool:
        """Return whether observed points block an arm that moves on from the first of some configurations (m, j).

        Without ``boxes``, points at boxes of the scan count, too.
        """
        points = self._unexplained_points(boxes)
        points = points[~self._arm.near(points, configurations[:1], _AT_ARM)]
        return bool(self._arm.near(points, configurations, CLEARANCE, moving=True).any())

    def unobserved(self, configurations: Array) -> Array:
        """Return points (k, 3) of an arm in configurations (m, j) that neither the scan nor the camera has observed.

        Unexplained occupied cells count as unobserved if ``unexplained`` is set. Points near the first configuration
        and near the target are left out. A scene without occupancy has no such points.
        """
        space = self._scene.occupancy
        if space is None:
            return np.zeros((0, 3))
        centers, moving = self._arm.centers(configurations), self._arm.moving
        offsets = self._arm.radius[moving, None, None] * np.concatenate([np.eye(3), -np.eye(3)])
        points = np.concatenate([centers[:, moving, None], centers[:, moving, None] + offsets], axis=2).reshape(-1, 3)
        in_scene = transform(self._scene_from_base, points)
        points = points[(~space.is_known(in_scene) | self._is_unexplained(in_scene)) & ~self._map.observed(points)]
        points = (np.unique(np.floor(points / _SPACING), axis=0) + 0.5) * _SPACING
        points = points[np.linalg.norm(points - self._target, axis=1) > self._tomato.radius + _TARGET_GAP]
        return np.asarray(points[~self._arm.near(points, configurations[:1], _ARM_GAP)])

    def unobserved_around_target(self) -> Array:
        """Return points (k, 3) around the target that the camera has not observed, even if the scan has."""
        along = np.arange(-_AROUND_TARGET, _AROUND_TARGET, _SPACING)
        offsets = np.stack(np.meshgrid(along, along, along), axis=-1).reshape(-1, 3)
        distances = np.linalg.norm(offsets, axis=1)
        around = (distances < _AROUND_TARGET) & (distances > self._tomato.radius + _TARGET_GAP)
        points = self._target + offsets[around]
        return np.asarray(points[~self._map.observed(points)])

    @cached_property
    def occupied(self) -> OpaqueCells:
        """The voxels that the scan found occupied."""
        space = self._scene.occupancy
        if space is None:
            return NOTHING_OPAQUE
        return OpaqueCells(space.states == OCCUPIED, space.origin, space.voxel, self._scene_from_base)

    def _is_unexplained(self, points: Array) -> npt.NDArray[np.bool_]:
        """Return which points (n, 3) of the scene lie in unexplained occupied cells, (n,)."""
        space = self._scene.occupancy
        if space is None or self._unexplained is None:
            return np.zeros(len(points), dtype=np.bool_)
        cells = space.cells_of(points)
        return (cells >= 0) & self._unexplained.reshape(-1)[cells]

    def _occupancy(self) -> OccupancyGrid | None:
        """Return the scan's occupancy with unknown and unexplained cells free where the camera has observed them."""
        space = self._scene.occupancy
        if space is None:
            return None
        states = space.states.copy()
        cells = np.argwhere(states == UNKNOWN if self._unexplained is None else (states == UNKNOWN) | self._unexplained)
        centers = transform(self._base_from_scene, space.origin + (cells + 0.5) * space.voxel)
        states[tuple(cells[self._map.observed(centers)].T)] = FREE
        return OccupancyGrid.from_states(states, space.origin, space.voxel, quick=True)


def _with_free_aisle(scene: Scene, base_from_scene: Array) -> Scene:
    """Return a scene in which the unknown space of the aisle is free."""
    space = scene.occupancy
    if space is None:
        return scene
    ahead = transform(base_from_scene, space.centers.reshape(-1, 3))[:, 0].reshape(space.shape)
    states = np.where((space.states == UNKNOWN) & (ahead > _AISLE[0]) & (ahead < _AISLE[1]), FREE, space.states)
    return scene.model_copy(
        update={"occupancy": OccupancyGrid.from_states(states, space.origin, space.voxel, quick=True)}
    )
