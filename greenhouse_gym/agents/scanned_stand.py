"""A scanned stand as a harvest changes it: fruit where the camera sees them, and the crate."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.sensed_hand import SensedHand
from greenhouse_gym.crops.parts import SpaceBox, is_leaf
from greenhouse_gym.geometry import Array, Box, Sphere, distance_to_nearest, pose
from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.unknown_space import guarded
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.occupancy import boxes_around_points

_GUARDS = 0.01, 0.003  # metres from which the arm keeps from itself, its cart, the crate, the gutter and strings
_VOXEL, _AROUND, _EXPLAINED, _OF_TARGET = 0.012, 0.4, 0.012, 0.03  # metres: see _unscanned
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
        """Return the scan with its fruit where they are now, and the crate.

        Args:
            around: Metres by which the crate is thickened.
            apart: Metres by which fruit except the target, and stems, are thickened.
            target: The target.
            seen: Whether what the camera sees and the scan lacks is clutter.
        """
        scene, fruit = self._problem.scene, self._hand.fruit
        tomatoes = []
        for k, tomato in enumerate(scene.tomatoes):
            # one that is off keeps its number, and is out of the way
            center = fruit.centers[k] if fruit.hanging[k] else np.array([0.0, 0.0, 9.0 + k])
            tomato = tomato.transformed(pose(translation=center - tomato.center))
            if apart and k != target:
                tomato = replace(tomato, shape=Sphere(center, tomato.radius + apart))
            tomatoes.append(tomato)
        stems = tuple(replace(stem, radius=stem.radius + apart) for stem in scene.stems) if apart else scene.stems
        clutter = (*scene.clutter, *self._crate(around), *self._gutter)
        parts = {"tomatoes": tuple(tomatoes), "stems": stems, "clutter": clutter, "targets": (), "truth": None}
        known = scene.model_copy(update=parts)
        return known.with_space(boxes_around_points(self._unscanned(), _VOXEL)) if seen else known

    def blocks(self, configurations: Array) -> bool:
        """Return whether the camera sees something in the way of an arm in configurations (m, j)."""
        arm, points = arm_spheres(self._problem.robot), (self._unscanned() - self._hand.base) @ self._hand.turn
        if not len(points):
            return False
        gaps, _ = cKDTree(points).query(arm.centers(configurations)[:, arm.moving])
        return bool((gaps < arm.radius[arm.moving]).any())

    def _unscanned(self) -> Array:
        """Return the points (n, 3) around the tip that the camera sees and nothing known explains."""
        hand, scan = self._hand, self._problem.scene
        points = hand.surface.points @ hand.turn.T + hand.base
        points = points[np.linalg.norm(points - hand.tip[0], axis=1) < _AROUND]
        points = points[distance_to_nearest(points, scan.arrays, _EXPLAINED) >= _EXPLAINED]
        fruit = np.append(np.flatnonzero(hand.fruit.hanging), hand.working)
        centers = np.array([hand.center(k) for k in fruit.tolist()]).reshape(-1, 3)
        gaps = cdist(points, centers) - hand.fruit.radii[fruit]
        return np.asarray(points[(gaps > np.append(np.full(len(fruit) - 1, _EXPLAINED), _OF_TARGET)).all(axis=1)])

    def is_free(self, configuration: Array) -> bool:
        """Return whether the arm is clear of itself, its cart, the crate, the gutter and strings; (j,) radians."""
        robot = self._problem.robot
        return self._checkers[0].is_free(np.clip(configuration, robot.lower, robot.upper))

    def stops(self, command: Array, change: Array) -> bool:
        """Return whether a change (j,) of the commands (j,) brings the arm nearer to these; radians.

        An arm that is near something already is stopped again before it touches it.
        """
        robot = self._problem.robot
        here, there = (np.clip(q, robot.lower, robot.upper) for q in (command, command + change))
        return any(checker.is_free(here) and not checker.is_free(there) for checker in self._checkers)

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
