"""A scanned stand as a harvest changes it: fruit where the camera sees them, and the crate."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.harvest.sensed_hand import SensedHand
from greenhouse_gym.crops.parts import SpaceBox, Stem, Tomato, is_leaf
from greenhouse_gym.geometry import Array, Box, Sphere, arrays_of, distance_to_nearest, pose
from greenhouse_gym.geometry.distances import distance_to_shapes
from greenhouse_gym.geometry.shape_arrays import shapes_from
from greenhouse_gym.geometry.shapes import AnyShape, Shape, transformed
from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.unknown_space import guarded
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.occupancy import boxes_around_points

_GUARDS = 0.01, 0.003  # metres from which the arm keeps from itself, its cart, the crate, the gutter and strings
_VOXEL, _FAR_VOXEL, _AROUND = 0.012, 0.024, 0.4  # metres: sides of seen cells around the tip, farther away, and between
_FRONT, _FLOOR = 0.3, -0.7  # metres before the base, and above it, from which what the camera sees are plants
_EXPLAINED, _OF_TARGET = 0.012, 0.03  # metres from known fruit, and from the one in work
_BLOCKED = 0.004  # metres from the arm at which what the camera sees is in its way
_WAIST = 0.006  # metres by which the spheres of a link fall short of it
_LEFT = 0.02  # metres from the arm within which what the camera sees is left out
_CONTACT = 0.006  # metres from known fruit and stems at which links do not move nearer
_ALONG, _ROW = 0.97, 1.5  # cosine to the row from which a piece lies along it, and half a gutter's length, metres


class ScannedStand:
    """The scan of an episode with what the hand knows by now.

    Args:
        problem: The episode.
        hand: Follows the fruit and feels where the crate is.
    """

    def __init__(self, problem: Problem, hand: SensedHand):
        self._problem, self._hand = problem, hand

    def scene(self, around: float, apart: float = 0.0, target: int = -1, seen: bool = False) -> Scene:
        """Return the scan with its trusses where they are now, fruit that it lacks, and the crate.

        Args:
            around: Metres by which the crate is thickened.
            apart: Metres by which fruit except the target, and stems, are thickened.
            target: The target.
            seen: Whether what the camera sees and the scan lacks is clutter.
        """
        scene, fruit, there = self._problem.scene, self._hand.fruit, self._there
        if target >= 0:
            there[target] = True
        tomatoes = []
        for k, tomato in enumerate(scene.tomatoes):
            # one that is off, or cannot be there, keeps its number and is out of the way
            center = fruit.centers[k] if there[k] else np.array([0.0, 0.0, 9.0 + k])
            tomato = tomato.transformed(pose(translation=center - tomato.center))
            if apart and k != target:
                tomato = replace(tomato, shape=Sphere(center, tomato.radius + apart))
            tomatoes.append(tomato)
        for k in range(len(scene.tomatoes), len(fruit.radii)):  # those that the scan lacks
            if there[k]:
                shape = Sphere(fruit.centers[k], float(fruit.radii[k]) + apart)
                tomatoes.append(Tomato(shape, int(fruit.of[k])))
        stems = [replace(stem, radius=stem.radius + apart) for stem in self._outside(self._stems())]
        clutter: list[Shape] = list(scene.clutter)
        points, broad = self._unscanned() if seen else (np.empty((0, 3)), np.empty(0, dtype=np.bool_))
        centers, radii = self._arm
        outside = (cdist(points, centers) - radii).min(axis=1, initial=np.inf) > _LEFT
        points, broad = points[outside], broad[outside]
        near = np.linalg.norm(points - self._hand.tip[0], axis=1) < _AROUND
        for part, voxel in ((near, _VOXEL), (~near, _FAR_VOXEL)):
            clutter += shapes_from(boxes_around_points(points[part & broad], voxel))  # counts as leaves
        clutter = [*self._outside(clutter), *self._crate(around), *self._gutter]
        parts = {"tomatoes": tuple(tomatoes), "stems": tuple(stems), "clutter": tuple(clutter), "targets": ()}
        known = scene.model_copy(update=parts | {"truth": None})
        for part, voxel in ((near, _VOXEL), (~near, _FAR_VOXEL)):
            known = known.with_space(boxes_around_points(points[part & ~broad], voxel))
        return known

    @property
    def _arm(self) -> tuple[Array, Array]:
        """Middles (b, 3) and radii (b,) of spheres that cover the arm where it is: nothing else can be there."""
        arm, hand = arm_spheres(self._problem.robot), self._hand
        return arm.centers(hand.command[None])[0][arm.moving] @ hand.turn.T + hand.base, arm.radius[arm.moving]

    @property
    def _there(self) -> npt.NDArray[np.bool_]:
        """(n,) which fruit hang, as far as it is known, where the arm is not."""
        (centers, radii), fruit = self._arm, self._hand.fruit
        apart = (cdist(centers, fruit.centers) - radii[:, None]).min(axis=0)
        return np.asarray(fruit.hanging & (apart >= fruit.radii + _WAIST))

    def _outside(self, shapes: list[AnyShape]) -> list[AnyShape]:
        """Return the shapes that the arm is not in."""
        if not shapes:
            return shapes
        centers, radii = self._arm
        clear = (distance_to_shapes(centers, shapes) - radii[:, None]).min(axis=0) > _WAIST
        return [shape for shape, free in zip(shapes, clear.tolist(), strict=True) if free]

    def _stems(self) -> list[Stem]:
        """Return the pieces of stem, those of trusses where they are now."""
        fruit = self._hand.fruit
        motions = [pose(turn, root - turn @ root) for turn, root in zip(fruit.turns, fruit.trusses.roots, strict=True)]
        truss_of = fruit.trusses.stems.tolist()
        return [
            stem if truss < 0 else transformed(stem, motions[truss])
            for stem, truss in zip(self._problem.scene.stems, truss_of, strict=True)
        ]

    def nearer(self, fruit: int, command: Array, change: Array) -> bool:
        """Return whether a change (j,) of the commands (j,) brings links of the arm onto known fruit or stems, radians.

        The truss of the fruit in work does not count.
        """
        known = self._hand.fruit
        truss = known.of[fruit]
        other = np.flatnonzero(self._there & (known.of != truss)).tolist()
        others = [Sphere(known.centers[k], float(known.radii[k])) for k in other]
        stems = [stem for stem, of in zip(self._stems(), known.trusses.stems.tolist(), strict=True) if of != truss]
        arm = arm_spheres(self._problem.robot)
        links = arm.centers(np.array([command, command + change]))[:, arm.moving] @ self._hand.turn.T + self._hand.base
        gaps = distance_to_nearest(links.reshape(-1, 3), arrays_of([*others, *stems]), 0.3).reshape(links.shape[:2])
        here, there = gaps - arm.radius[arm.moving]
        return bool(((there < _CONTACT) & (there < here)).any())

    def blocks(self, configurations: Array, leaves: bool) -> bool:
        """Return whether the camera sees something, or only leaves, in the way of an arm in configurations (m, j)."""
        arm, (points, broad) = arm_spheres(self._problem.robot), self._unscanned()
        points = points if leaves else points[~broad]
        if not len(points):
            return False
        gaps, _ = cKDTree((points - self._hand.base) @ self._hand.turn).query(
            arm.centers(configurations)[:, arm.moving]
        )
        return bool((gaps < arm.radius[arm.moving] + _BLOCKED).any())

    def _unscanned(self) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return the points (n, 3) that the camera sees and nothing known explains.

        A mask (n,) says which ones belong to broad things.
        """
        hand = self._hand
        points, broad = hand.surface.points, hand.surface.broad
        plants = (points[:, 0] > _FRONT) & (points[:, 2] > _FLOOR)  # the rest is the cart, the crate and the floor
        points, broad = points[plants] @ hand.turn.T + hand.base, broad[plants]
        fruit = np.append(np.flatnonzero(hand.fruit.hanging), hand.working)
        centers = np.array([hand.center(k) for k in fruit.tolist()]).reshape(-1, 3)
        gaps = cdist(points, centers) - hand.fruit.radii[fruit]
        left = (gaps > np.append(np.full(len(fruit) - 1, _EXPLAINED), _OF_TARGET)).all(axis=1)
        return points[left], broad[left]

    def is_free(self, configuration: Array) -> bool:
        """Return whether the arm is clear of itself, its cart, the crate, the gutter and strings; (j,) radians."""
        robot = self._problem.robot
        return self._checkers[0].is_free(np.clip(configuration, robot.lower, robot.upper))

    def stops(self, command: Array, change: Array, close: bool = False) -> bool:
        """Return whether a change (j,) of the commands (j,) brings the arm nearer to these; radians.

        An arm that is near something already is stopped again before it touches it; with ``close``, only then.
        """
        robot = self._problem.robot
        here, there = (np.clip(q, robot.lower, robot.upper) for q in (command, command + change))
        return any(checker.is_free(here) and not checker.is_free(there) for checker in self._checkers[close:])

    @cached_property
    def _checkers(self) -> list[CollisionChecker]:
        scene = self._problem.scene
        strings = tuple(stem for stem in scene.stems if stem.kind == "string")
        parts = {
            "stems": strings,
            "clutter": (*self._crate(0.0), *self._gutter),
            "targets": (),
            "truth": None,
            "occupancy": None,
        }
        compiled = guarded(scene.model_copy(update=parts), self._problem.robot, self._problem.start, np.inf)
        pairs = ("stems", "clutter", "fixture", "self")
        return [CollisionChecker(planning_model(compiled, 0, guard, pairs=pairs)) for guard in _GUARDS]

    @cached_property
    def _gutter(self) -> tuple[SpaceBox, ...]:
        """Return the gutter and the space below it along the whole row; the scan shows pieces of its upper faces."""
        boxes = [piece for piece in self._problem.scene.clutter if isinstance(piece, Box) and not is_leaf(piece)]
        pieces = [box for box in boxes if abs(box.rotation[1, box.half_extents.argmax()]) > _ALONG]
        if not pieces:
            return ()
        reaches = np.array([np.abs(box.rotation) @ box.half_extents for box in pieces])
        centers = np.array([box.center for box in pieces])
        low, high = (centers - reaches).min(axis=0), (centers + reaches).max(axis=0)
        low[1:], high[1] = [-_ROW, 0.0], _ROW
        return (SpaceBox((low + high) / 2, (high - low) / 2, np.eye(3)),)

    def _crate(self, around: float) -> tuple[SpaceBox, ...]:
        """Return the walls of the crate, thickened by some metres."""
        crate, turn = self._problem.crate, self._hand.turn
        assert crate is not None
        middle = self._hand.crate - [0.0, 0.0, 2 * crate.half_extents[2]]
        return tuple(SpaceBox(turn @ at + middle, half + around, turn) for at, half in crate.boxes)
