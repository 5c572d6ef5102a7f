"""Which scene, target and start an episode has: sampled from a bank, or named in the reset's options."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import DIFFICULTIES, Scene, SceneBank, Target
from greenhouse_gym.scene.bank import SPLITS

UNRATED = "unrated"
"""Difficulty of a tomato that the scene does not list as a target."""

OPTIONS = ("scene", "target", "start")
_DRAWS = 64


@dataclass(frozen=True, eq=False)
class Episode:
    """What an episode is about.

    Attributes:
        scene: The scene.
        target: Index of the target among the scene's tomatoes.
        difficulty: One of `DIFFICULTIES`, or `UNRATED`.
        start: (joints,) start configuration, radians.
    """

    scene: Scene
    target: int
    difficulty: str
    start: Array


class EpisodeSampler:
    """Draws episodes from one split of a bank: a scene, then one of its targets of the wanted difficulties.

    Args:
        bank: Name, folder or `SceneBank`.
        split: One of "train", "validation", "test".
        robot: The arm; only targets rated for it are drawn.
        difficulty: One difficulty or several of `DIFFICULTIES`.
    """

    def __init__(self, bank: str | Path | SceneBank, split: str, robot: Robot, difficulty: str | Iterable[str]):
        self.bank = SceneBank.open(bank)
        self.split = require_choice("split", split, SPLITS)
        self.robot = robot
        wanted = (difficulty,) if isinstance(difficulty, str) else tuple(difficulty)
        if not wanted:
            raise InvalidValueError(f"difficulty is empty; choices: {', '.join(DIFFICULTIES)}")
        self.difficulties = tuple(require_choice("difficulty", name, DIFFICULTIES) for name in wanted)
        self._names = self.bank.names(split)
        if not self._names:
            raise InvalidValueError(f"bank {self.bank.path} has no scene in split {split!r}")

    def draw(self, random: np.random.Generator, options: Mapping[str, Any] | None = None) -> Episode:
        """Draw an episode; ``options`` may fix the scene (name or `Scene`), the target (tomato) and the start.

        Raises:
            UnknownNameError: An option or scene of that name does not exist.
            InvalidValueError: A target or start is outside what is allowed, or no target fits the difficulties.
        """
        options = options or {}
        for key in options:
            require_choice("reset option", key, OPTIONS)
        scene = options.get("scene")
        if scene is None:
            if options.get("target") is not None:
                raise InvalidValueError("the reset option 'target' needs the option 'scene'")
            scene, fitting = self._draw_scene(random)
        else:
            scene = scene if isinstance(scene, Scene) else self.bank.scene(str(scene))
            fitting = self._fitting(scene)
        tomato = options.get("target")
        if tomato is None:
            if not fitting:
                raise InvalidValueError(self._nothing_fits(f"scene {scene.name!r}"))
            target = fitting[int(random.integers(len(fitting)))]
            tomato, difficulty = target.tomato, str(target.difficulty)
        else:
            tomato, difficulty = self._rate(scene, tomato)
        return Episode(scene, tomato, difficulty, self._start(options.get("start")))

    def _draw_scene(self, random: np.random.Generator) -> tuple[Scene, list[Target]]:
        # Drawing again when a scene has no fitting target keeps scenes equally likely without reading them all.
        for _ in range(_DRAWS):
            scene = self.bank.scene(self._names[int(random.integers(len(self._names)))])
            if fitting := self._fitting(scene):
                return scene, fitting
        scenes = [scene for scene in map(self.bank.scene, self._names) if self._fitting(scene)]
        if not scenes:
            raise InvalidValueError(self._nothing_fits(f"split {self.split!r} of bank {self.bank.path}"))
        scene = scenes[int(random.integers(len(scenes)))]
        return scene, self._fitting(scene)

    def _fitting(self, scene: Scene) -> list[Target]:
        return [t for t in scene.targets if t.robot == self.robot.name and t.difficulty in self.difficulties]

    def _nothing_fits(self, where: str) -> str:
        return f"{where} has no target rated {' or '.join(self.difficulties)} for robot {self.robot.name!r}"

    def _rate(self, scene: Scene, tomato: Any) -> tuple[int, str]:
        count = len(scene.tomatoes)
        if isinstance(tomato, bool) or not isinstance(tomato, (int, np.integer)) or not 0 <= tomato < count:
            raise InvalidValueError(
                f"target must be a tomato of scene {scene.name!r}, 0 to {count - 1}, got {tomato!r}"
            )
        rated = (str(t.difficulty) for t in scene.targets if t.tomato == tomato and t.robot == self.robot.name)
        return int(tomato), next(rated, UNRATED)

    def _start(self, start: Any) -> Array:
        if start is None:
            return self.robot.start
        robot = self.robot
        try:
            q = np.array(start, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InvalidValueError(f"start must be {len(robot.joints)} angles, got {start!r}") from error
        if q.shape != robot.start.shape or not np.isfinite(q).all():
            raise InvalidValueError(f"start must be {len(robot.joints)} finite angles in radians, got {start!r}")
        if ((q < robot.lower) | (q > robot.upper)).any():
            raise InvalidValueError(
                f"start {q.tolist()} is outside the joint limits {robot.lower.tolist()} to {robot.upper.tolist()}"
            )
        return q
