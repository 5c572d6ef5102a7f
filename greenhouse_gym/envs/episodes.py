"""Which scene, target and start an episode has: sampled from a bank, or named in the reset's options."""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from greenhouse_gym.envs.scene_window import WINDOW, SceneWindow
from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import DIFFICULTIES, Scene, SceneBank, Target
from greenhouse_gym.scene.manifest import SPLITS

UNRATED = "unrated"
"""Difficulty of a tomato that the scene does not list as a target."""

OPTIONS = ("scene", "target", "start", "difficulty")

DifficultyChoice: TypeAlias = str | Iterable[str] | Mapping[str, float]
"""One difficulty, several, or a weight for each."""

_DRAWS = 64
_KEPT = 300


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

    Of a large bank few scenes are drawn from at a time; see `greenhouse_gym.envs.scene_window`.

    An arm that a scene has no ratings for gets the targets that are rated for other arms, as `UNRATED` ones.

    Args:
        bank: Name, folder or `SceneBank`.
        split: One of "train", "validation", "test".
        robot: The arm.
        difficulty: One difficulty, several, or weights: the difficulty is drawn by weight then, before the scene.
        start: Where the arm starts, as the reset's option; its own start when left out.
    """

    def __init__(
        self,
        bank: str | Path | SceneBank,
        split: str,
        robot: Robot,
        difficulty: DifficultyChoice,
        start: str | Sequence[float] | None = None,
    ):
        self.bank = SceneBank.open(bank)
        self.split = require_choice("split", split, SPLITS)
        self.robot = robot
        self._usual_start = self._start(start)
        # kept with its scene, so that the scene's identity stays its own; those asked for last
        self._kept: OrderedDict[tuple[int, tuple[str, ...]], tuple[Scene, list[Target]]] = OrderedDict()
        self.set_difficulty(difficulty)
        self._names = self.bank.names(split)
        if not self._names:
            filled = [name for name in SPLITS if self.bank.names(name)]
            raise InvalidValueError(
                f"bank {self.bank.path} has no scene in split {split!r}; choices: {', '.join(filled) or '(none)'}"
            )
        self._window = SceneWindow(self._names)

    def __deepcopy__(self, memo: dict[int, Any]) -> EpisodeSampler:
        """A sampler whose difficulties are its own; the bank is shared."""
        twin = copy.copy(self)
        twin._kept, twin._window = OrderedDict(), copy.copy(self._window)
        return twin

    @property
    def at_a_time(self) -> int | None:
        """How many scenes of a large bank are drawn from at a time; None where all are."""
        return None if self._window.whole else WINDOW

    def restart(self, seed: int) -> None:
        """From now on, draw the scenes of a large bank in the order of a seed; a small bank stays as it is."""
        self._window.restart(seed)

    def set_difficulty(self, difficulty: DifficultyChoice) -> None:
        """Draw targets of these difficulties from the next episode on.

        Raises:
            UnknownNameError: There is no such difficulty.
            InvalidValueError: None is given, or the weights are negative or all zero.
        """
        self._wanted = parse_difficulty(difficulty)

    @property
    def difficulty(self) -> dict[str, float]:
        """Weight of each difficulty that is drawn, or 0 for all where they are drawn as the scenes have them."""
        return dict(self._wanted)

    def draw(self, rng: np.random.Generator, options: Mapping[str, Any] | None = None) -> Episode:
        """Draw an episode; ``options`` may fix the scene (name or `Scene`), target (tomato), start and difficulty.

        Raises:
            UnknownNameError: An option, scene or difficulty of that name does not exist.
            InvalidValueError: A target or start is outside what is allowed, or no target fits the difficulties.
        """
        if options is not None and not isinstance(options, Mapping):
            raise InvalidValueError(f"reset options must be a dict, got {options!r}")
        options = options or {}
        for key in options:
            require_choice("reset option", key, OPTIONS)
        wanted = self._wanted if options.get("difficulty") is None else parse_difficulty(options["difficulty"])
        start = self._usual_start if options.get("start") is None else self._start(options["start"])
        scene, tomato = options.get("scene"), options.get("target")
        if scene is None and tomato is not None:
            raise InvalidValueError("the reset option 'target' needs the option 'scene'")
        if scene is not None:
            if not isinstance(scene, (Scene, str)):
                raise InvalidValueError(f"the reset option 'scene' must be a scene's name or a Scene, got {scene!r}")
            scene = self.bank.scene(scene) if isinstance(scene, str) else scene
        if tomato is not None:
            assert scene is not None
            return Episode(scene, *self._rate(scene, tomato), start)
        names = _draw_difficulty(wanted, rng)
        if scene is None:
            scene, fitting = self._draw_scene(rng, names)
        elif not (fitting := self._fitting(scene, names)):
            raise InvalidValueError(self._nothing_fits(f"scene {scene.name!r}", names))
        target = fitting[int(rng.integers(len(fitting)))]
        return Episode(scene, target.tomato, self._rating(target), start)

    def _draw_scene(self, rng: np.random.Generator, names: tuple[str, ...]) -> tuple[Scene, list[Target]]:
        # Drawing again when a scene has no fitting target keeps scenes equally likely without reading them all.
        for _ in range(_DRAWS):
            scene = self.bank.scene(self._window.draw(rng))
            if fitting := self._fitting(scene, names):
                return scene, fitting
        scenes = [scene for scene in map(self.bank.scene, self._names) if self._fitting(scene, names)]
        if not scenes:
            raise InvalidValueError(self._nothing_fits(f"split {self.split!r} of bank {self.bank.path}", names))
        scene = scenes[int(rng.integers(len(scenes)))]
        return scene, self._fitting(scene, names)

    def _fitting(self, scene: Scene, names: tuple[str, ...]) -> list[Target]:
        key = (id(scene), names)
        if key not in self._kept:
            mine = [target for target in scene.targets if target.robot == self.robot.name]
            rated = mine or list({target.tomato: target for target in scene.targets}.values())
            self._kept[key] = (scene, [target for target in rated if target.difficulty in names])
        self._kept.move_to_end(key)
        while len(self._kept) > (self.at_a_time or _KEPT):
            self._kept.popitem(last=False)
        return self._kept[key][1]

    def _rating(self, target: Target) -> str:
        return str(target.difficulty) if target.robot == self.robot.name else UNRATED

    def _nothing_fits(self, where: str, names: tuple[str, ...]) -> str:
        return (
            f"{where} has no target rated {' or '.join(names)} for robot {self.robot.name!r}; difficulties are "
            f"{', '.join(DIFFICULTIES)}"
        )

    def _rate(self, scene: Scene, tomato: Any) -> tuple[int, str]:
        count = len(scene.tomatoes)
        if isinstance(tomato, bool) or not isinstance(tomato, (int, np.integer)) or not 0 <= tomato < count:
            raise InvalidValueError(
                f"target must be a tomato of scene {scene.name!r}, 0 to {count - 1}, got {tomato!r}"
            )
        rated = (str(t.difficulty) for t in scene.targets if t.tomato == tomato and t.robot == self.robot.name)
        return int(tomato), next(rated, UNRATED)

    def _start(self, start: Any) -> Array:
        robot = self.robot
        start = robot.configuration(start)
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


def parse_difficulty(difficulty: DifficultyChoice) -> dict[str, float]:
    """Names of difficulties with their weights, which are all 0 where none were given.

    Raises:
        UnknownNameError: There is no such difficulty.
        InvalidValueError: None is given, or the weights are negative or all zero.
    """
    if not isinstance(difficulty, (str, Iterable)):
        raise InvalidValueError(
            f"difficulty must be one of {', '.join(DIFFICULTIES)}, several, or a weight for each, got {difficulty!r}"
        )
    if isinstance(difficulty, Mapping):
        weights = {require_choice("difficulty", name, DIFFICULTIES): _weight(w) for name, w in difficulty.items()}
        if not all(np.isfinite(w) and w >= 0 for w in weights.values()) or not any(weights.values()):
            raise InvalidValueError(f"difficulty weights must be from 0 up and not all 0, got {dict(difficulty)}")
        return {name: weight for name, weight in weights.items() if weight > 0}
    names = (difficulty,) if isinstance(difficulty, str) else tuple(difficulty)
    if not names:
        raise InvalidValueError(f"difficulty is empty; choices: {', '.join(DIFFICULTIES)}")
    return {require_choice("difficulty", name, DIFFICULTIES): 0.0 for name in names}


def _weight(weight: Any) -> float:
    try:
        return float(weight)
    except (TypeError, ValueError) as error:
        raise InvalidValueError(f"a difficulty's weight must be a number, got {weight!r}") from error


def _draw_difficulty(wanted: Mapping[str, float], rng: np.random.Generator) -> tuple[str, ...]:
    names = tuple(wanted)
    total = sum(wanted.values())
    if total == 0 or len(names) == 1:
        return names
    return (names[int(rng.choice(len(names), p=[weight / total for weight in wanted.values()]))],)
