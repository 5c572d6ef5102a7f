"""A scanned stand as a harvest changes it: fruit where the camera sees them, and the crate."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.sensed_hand import SensedHand
from greenhouse_gym.crops.parts import SpaceBox
from greenhouse_gym.geometry import Array, Sphere, pose
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.unknown_space import guarded
from greenhouse_gym.scene import Scene

_GUARD = 0.005  # metres from which the arm keeps from itself, its cart, the crate and strings


class ScannedStand:
    """The scan of an episode with what the hand knows by now.

    Args:
        problem: The episode.
        hand: Follows the fruit and feels where the crate is.
    """

    def __init__(self, problem: Problem, hand: SensedHand):
        self._problem, self._hand = problem, hand

    def scene(self, around: float, apart: float = 0.0, target: int = -1) -> Scene:
        """Return the scan with its fruit where they are now, and the crate.

        Args:
            around: Metres by which the crate is thickened.
            apart: Metres by which fruit except the target, and stems, are thickened.
            target: The target.
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
        clutter = (*scene.clutter, *self._crate(around))
        parts = {"tomatoes": tuple(tomatoes), "stems": stems, "clutter": clutter, "targets": (), "truth": None}
        return scene.model_copy(update=parts)

    def is_free(self, configuration: Array) -> bool:
        """Return whether the arm touches neither itself, nor its cart, the crate or a string; (j,) radians."""
        robot = self._problem.robot
        return self._checker.is_free(np.clip(configuration, robot.lower, robot.upper))

    @cached_property
    def _checker(self) -> CollisionChecker:
        scene = self._problem.scene
        strings = tuple(stem for stem in scene.stems if stem.kind == "string")
        parts = {"stems": strings, "clutter": self._crate(0.0), "targets": (), "truth": None, "occupancy": None}
        compiled = guarded(scene.model_copy(update=parts), self._problem.robot, self._problem.start, np.inf)
        return CollisionChecker(planning_model(compiled, 0, _GUARD, pairs=("stems", "clutter", "fixture", "self")))

    def _crate(self, around: float) -> tuple[SpaceBox, ...]:
        """Return the walls of the crate, thickened by some metres."""
        crate, turn = self._problem.crate, self._hand.turn
        assert crate is not None
        middle = self._hand.crate - [0.0, 0.0, 2 * crate.half_extents[2]]
        return tuple(SpaceBox(turn @ at + middle, half + around, turn) for at, half in crate.boxes)
