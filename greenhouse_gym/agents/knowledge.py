"""What an arm knows of the plants around it: the scan, and what the camera at its wrist has shown beside it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.sight_map import SightMap
from greenhouse_gym.geometry import (
    Array,
    Box,
    bounding_balls,
    distance_to_nearest,
    distance_to_shapes,
    invert,
    pose,
    rotation_about,
    transform,
)
from greenhouse_gym.motion.arm_spheres import arm_balls
from greenhouse_gym.motion.unexplained_cells import unexplained_cells
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import base_position
from greenhouse_gym.scene.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, boxes_around_points

ROOM = 0.002
"""How near the arm may come to what its camera has shown, metres."""

_KNOWN, _SKIN = 0.001, 0.008  # what the camera shows so near to a scan's shape, or the target's, is that, metres
_CLEAR = 0.01  # what the camera shows nearer to the arm than this is no obstacle to a way that begins there, metres
_MAX = 0.8  # share of a box that the camera has seen, which from then on is what the camera shows
_DARK = 0.03  # places in unknown space that are told are that far apart, metres
_ABOUT = 0.2  # places about the target are told up to here, metres
_AROUND, _AT_TARGET = 0.02, 0.02  # unknown space so near to where the arm is, or to the target, is not told, metres


class Knowledge:
    """The scene of a scan, to which a camera adds what it shows; places are in the frame of the arm's base.

    Args:
        problem: The episode.
        target: (3,) the target's center, metres.
        camera: The camera at the arm's wrist.
        unexplained: Whether a surface for which the scan has no shape is dark until the camera has looked there.
        noisy: Whether the camera's images have the noise of a D435.

    Attributes:
        points: (n, 3) what the camera has shown where the scan has no shape, metres.
        boxed: (n, 3) what it has shown where the scan has none but boxes of clutter, metres.
    """

    def __init__(
        self, problem: Problem, target: Array, camera: DepthCamera, unexplained: bool = False, noisy: bool = False
    ):
        scene = problem.scene
        self._unexplained = unexplained_cells(scene) if unexplained and scene.occupancy is not None else None
        self.points: Array = np.zeros((0, 3))
        self.boxed: Array = np.zeros((0, 3))
        self._problem, self._arm, self._target = problem, arm_balls(problem.robot), target
        self._radius = scene.tomatoes[problem.target].radius
        self._map = SightMap(self._arm, camera, target, self._radius, noisy)
        self._scene_from_base = pose(
            rotation_about([0, 0, 1], scene.placement.yaw), base_position(scene, problem.robot)
        )
        self._base_from_scene = invert(self._scene_from_base)
        self._shapes, self._taken = scene.obstacles, 0
        self._balls = bounding_balls(self._shapes)
        self._firm = [shape for shape in self._shapes if not isinstance(shape, Box)]
        self._firm_balls = bounding_balls(self._firm)
        self._tomato = scene.tomatoes[problem.target].shape

    def add(self, depth: npt.NDArray[np.float32], joints: Array) -> bool:
        """Take in an image (h, w), metres along the view, from a configuration (j,); whether it showed anything new."""
        self._map.add(depth, joints)
        fresh, doubt = self._map.points[self._taken :], self._map.doubt[self._taken :]
        self._taken += len(fresh)
        if len(fresh):
            places = transform(self._scene_from_base, fresh)
            known = np.maximum(_KNOWN, doubt)
            away = distance_to_nearest(places, self._shapes, float(known.max()), self._balls)
            beside = distance_to_shapes(places, [self._tomato])[:, 0]
            foreign = beside > _SKIN + doubt
            boxed = foreign & (away <= known)
            firm = distance_to_nearest(places[boxed], self._firm, float(known.max()), self._firm_balls)
            boxed[boxed] = firm > known[boxed]
            self.boxed = np.concatenate([self.boxed, fresh[boxed]])
            fresh = fresh[foreign & (away > known)]
            self.points = np.concatenate([self.points, fresh])
        return bool(len(fresh))

    def scene(self, command: Array, voxel: float, boxes: bool = True) -> Scene:
        """The scene for an arm in a configuration (j,): the scan's, and clutter where the camera has shown more.

        The clutter is made of voxels, metres: the smaller they are, the less they stand for beside what was shown.
        Without ``boxes``, what the camera has shown also stands for those of the scan's boxes that it has looked at.
        """
        scene = self._problem.scene
        shown = self._shown(boxes)
        centers = self._arm.centers(command[None])[0]
        points = transform(self._scene_from_base, shown[self._gap(shown, centers) > _CLEAR])
        kept = [shape for shape in scene.clutter if boxes or not isinstance(shape, Box) or not self._looked_at(shape)]
        return scene.model_copy(
            update={"clutter": (*kept, *boxes_around_points(points, voxel)), "occupancy": self._seen()}
        )

    def _shown(self, boxes: bool) -> Array:
        return self.points if boxes else np.concatenate([self.points, self.boxed])

    def _looked_at(self, box: Box) -> bool:
        """Whether the camera has seen most of a box of the scan's clutter."""
        along = [np.linspace(-1, 1, 2 + int(2 * half / _DARK)) * half for half in np.asarray(box.half_extents)]
        inside = np.stack(np.meshgrid(*along), axis=-1).reshape(-1, 3) @ np.asarray(box.rotation).T + box.center
        return bool(self._map.seen(transform(self._base_from_scene, inside)).mean() > _MAX)

    def blocked(self, configurations: Array, boxes: bool = True) -> bool:
        """Whether what only the camera has shown is in the way of an arm that goes on from the first of some (m, j).

        Without ``boxes``, that is also what it has shown in or on boxes of the scan.
        """
        centers, moving = self._arm.centers(configurations), self._arm.part >= 0
        points = self._shown(boxes)
        points = points[self._gap(points, centers[0]) > _CLEAR]
        if not len(points):
            return False
        radius = self._arm.radius[moving]
        away, _ = cKDTree(points).query(centers[:, moving], distance_upper_bound=float(radius.max()) + ROOM)
        return bool((away - radius).min() < ROOM)

    def dark(self, configurations: Array) -> Array:
        """(k, 3) places that nobody has seen, or the scan has no shape for, and an arm in configurations (m, j) is in.

        Those where it is at first and those at the target are left out. There are none in a scene that does not say
        what was seen of it.
        """
        space = self._problem.scene.occupancy
        if space is None:
            return np.zeros((0, 3))
        balls, moving = self._arm.centers(configurations), self._arm.part >= 0
        outside = self._arm.radius[moving, None, None] * np.concatenate([np.eye(3), -np.eye(3)])
        ahead = np.concatenate([balls[:, moving, None], balls[:, moving, None] + outside], axis=2).reshape(-1, 3)
        places = transform(self._scene_from_base, ahead)
        ahead = ahead[(~space.is_known(places) | self._without_shape(places)) & ~self._map.seen(ahead)]
        ahead = (np.unique(np.floor(ahead / _DARK), axis=0) + 0.5) * _DARK
        ahead = ahead[np.linalg.norm(ahead - self._target, axis=1) > self._radius + _AT_TARGET]
        return np.asarray(ahead[self._gap(ahead, balls[0]) > _AROUND])

    def unlooked(self) -> Array:
        """(k, 3) places about the target that the camera has not seen, whatever the scan says of them."""
        along = np.arange(-_ABOUT, _ABOUT, _DARK)
        off = np.stack(np.meshgrid(along, along, along), axis=-1).reshape(-1, 3)
        away = np.linalg.norm(off, axis=1)
        places = self._target + off[(away < _ABOUT) & (away > self._radius + _AT_TARGET)]
        return np.asarray(places[~self._map.seen(places)])

    def surface(self, places: Array) -> npt.NDArray[np.bool_]:
        """Which of places (n, 3) are in voxels in which the scan saw a surface, (n,)."""
        space = self._problem.scene.occupancy
        if space is None:
            return np.zeros(len(places), dtype=np.bool_)
        return np.asarray(space.states_at(transform(self._scene_from_base, places)) == OCCUPIED)

    def _without_shape(self, places: Array) -> npt.NDArray[np.bool_]:
        """Which of places (n, 3) of the scene are where the scan saw a surface and has no shape, (n,)."""
        space = self._problem.scene.occupancy
        if space is None or self._unexplained is None:
            return np.zeros(len(places), dtype=np.bool_)
        cells = np.floor((places - space.origin) / space.voxel).astype(np.int64)
        inside = ((cells >= 0) & (cells < space.shape)).all(axis=1)
        found = np.zeros(len(places), dtype=np.bool_)
        found[inside] = self._unexplained[tuple(cells[inside].T)]
        return found

    def _gap(self, points: Array, centers: Array) -> Array:
        """(n,) distances of points (n, 3) to the arm with its balls at centers (b, 3), metres, negative inside."""
        return np.asarray((cdist(points, centers) - self._arm.radius).min(axis=1, initial=np.inf))

    def _seen(self) -> OccupancyGrid | None:
        space = self._problem.scene.occupancy
        if space is None:
            return None
        states = space.states.copy()
        cells = np.argwhere(states == UNKNOWN if self._unexplained is None else (states == UNKNOWN) | self._unexplained)
        centers = transform(self._base_from_scene, space.origin + (cells + 0.5) * space.voxel)
        states[tuple(cells[self._map.seen(centers)].T)] = FREE
        return OccupancyGrid.from_states(states, space.origin, space.voxel)
