"""Episodes: scene, targets and start, sampled from a bank or given by the options of a reset."""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import DIFFICULTIES, Scene, SceneBank, Target
from greenhouse_gym.scene.manifest import SPLITS

UNRATED = "unrated"
"""Difficulty of a tomato that is not rated for the arm."""

OPTIONS = ("scene", "target", "start", "difficulty")

DifficultyChoice: TypeAlias = str | Iterable[str] | Mapping[str, float]
"""One difficulty, several, or a weight for each."""

LARGEST_WHOLE = 300
"""Maximum number of scenes of a split without a window."""

LARGEST_COMPLIANT = 60
"""The same where plants are compliant: a true row and its organs take 26 MB."""

WINDOW = 24
"""Number of scenes in the window."""

DRAWS_PER_SCENE = 256
"""Number of draws after which the next scene enters the window; each scene is drawn about as often."""

_DRAWS = 64
_CACHED = 300


@dataclass(frozen=True, eq=False)
class Episode:
    """Scene, targets and start of an episode.

    Attributes:
        scene: The scene.
        targets: Indices of the target tomatoes in the scene, in the order in which they become the target.
        difficulty: Rating of the first target, one of `DIFFICULTIES`, or `UNRATED`.
        start: (joints,) start configuration, radians.
        fruit: Indices of the fruit to be picked among the tomatoes of the scene's truth; by default the counterparts
            of the targets. Only compliant plants have fruit that comes off.
    """

    scene: Scene
    targets: tuple[int, ...]
    difficulty: str
    start: Array
    fruit: tuple[int, ...] = ()


class SceneWindow:
    """Sliding window over the scenes of a split, from which names of scenes are drawn; deterministic for a seed.

    Reading and compiling a scene and computing its distance field take as long as hundreds of steps. Therefore episodes
    of a large bank are drawn from a few scenes at a time, which stay in memory. They are replaced one by one in an
    order that the seed shuffles, until every scene had its turn and the next round begins.

    Args:
        names: Names of all scenes.
        largest: Maximum number of scenes that are drawn from as a whole; `LARGEST_WHOLE` by default.
    """

    def __init__(self, names: Sequence[str], largest: int | None = None):
        self._names = names
        self._largest = LARGEST_WHOLE if largest is None else largest
        self._order: np.ndarray[tuple[int], np.dtype[np.int64]] | None = None
        self._draws = 0

    @property
    def whole(self) -> bool:
        """True if the split is small enough to be drawn from as a whole."""
        return len(self._names) <= self._largest

    def restart(self, seed: int) -> None:
        """Begin a new round in the order given by a seed."""
        if not self.whole:
            self._order, self._draws = np.random.default_rng(seed).permutation(len(self._names)), 0

    def draw(self, rng: np.random.Generator) -> str:
        """Draw the name of a scene, uniformly within the window."""
        if self.whole:
            return self._names[int(rng.integers(len(self._names)))]
        if self._order is None:
            self.restart(int(rng.integers(2**32)))
        assert self._order is not None
        first = self._draws // DRAWS_PER_SCENE
        position = int(rng.integers(first, first + WINDOW))
        self._draws += 1
        return self._names[int(self._order[position % len(self._order)])]


class EpisodeSampler:
    """Sampler of episodes from one split of a bank: a scene, then one of its targets with a matching difficulty.

    Episodes of a large bank are drawn from a few scenes at a time, see `SceneWindow`. If a scene
    is not rated for the arm, the targets rated for other arms are used, as `UNRATED` ones.

    Args:
        bank: Name, folder or `SceneBank`.
        split: "train", "validation" or "test".
        robot: The arm.
        difficulty: One difficulty, several, or weights. With weights, the difficulty is drawn before the scene.
        start: Start configuration, as in the options of a reset; the arm's default if None.
        scene: The only scene, as in the options of a reset; each episode draws one if None.
        target: Its only target, as in the options of a reset; each episode draws one if None.
        largest: Maximum number of scenes that are drawn from as a whole.

    Raises:
        UnknownNameError: The split, the scene, a difficulty or a start does not exist.
        InvalidValueError: The split has no scene, or the scene no such target.
    """

    def __init__(
        self,
        bank: str | Path | SceneBank,
        split: str,
        robot: Robot,
        difficulty: DifficultyChoice,
        start: str | Sequence[float] | None = None,
        scene: str | Scene | None = None,
        target: int | None = None,
        largest: int | None = None,
    ):
        self.bank = SceneBank.open(bank)
        self.split = require_choice("split", split, SPLITS)
        self.robot = robot
        self._default_start = self._start(start)
        # entries hold their scene, so that the id of a scene in a key is not reused
        self._cache: OrderedDict[tuple[int, tuple[str, ...]], tuple[Scene, list[Target]]] = OrderedDict()
        self.set_difficulty(difficulty)
        self._names = self.bank.names(split)
        self._only: dict[str, Any] = {} if scene is None else {"scene": self._scene(scene)}
        if scene is not None and target is not None:
            self._only["target"] = self._rate(self._scene(scene), target)[0]
        if not self._names and scene is None:
            filled = [name for name in SPLITS if self.bank.names(name)]
            raise InvalidValueError(
                f"bank {self.bank.path} has no scene in split {split!r}; choices: {', '.join(filled) or '(none)'}"
            )
        self._window = SceneWindow(self._names, largest)

    def __deepcopy__(self, memo: dict[int, Any]) -> EpisodeSampler:
        """Return an independent sampler that shares the bank."""
        twin = copy.copy(self)
        twin._cache, twin._window = OrderedDict(), copy.copy(self._window)
        return twin

    @property
    def at_a_time(self) -> int | None:
        """Number of scenes of a large bank that are drawn from at a time; None for a small bank."""
        return None if self._window.whole else WINDOW

    def restart(self, seed: int) -> None:
        """Restart the order of the scenes of a large bank with a seed; no effect on a small bank."""
        self._window.restart(seed)

    def set_difficulty(self, difficulty: DifficultyChoice) -> None:
        """Set the difficulties of targets from the next episode on.

        Raises:
            UnknownNameError: A difficulty does not exist.
            InvalidValueError: No difficulty is given, or the weights are negative or all zero.
        """
        self._wanted = parse_difficulty(difficulty)

    @property
    def difficulty(self) -> dict[str, float]:
        """Weight of each chosen difficulty; all 0 if they are drawn at their natural frequency."""
        return dict(self._wanted)

    def draw(self, rng: np.random.Generator, options: Mapping[str, Any] | None = None) -> Episode:
        """Draw an episode with one target; ``options`` may fix scene (name or `Scene`), target, start and difficulty.

        Raises:
            UnknownNameError: An option, scene or difficulty does not exist.
            InvalidValueError: A target or start is invalid, or no target has a matching difficulty.
        """
        if options is not None and not isinstance(options, Mapping):
            raise InvalidValueError(f"reset options must be a dict, got {options!r}")
        for key in options or {}:
            require_choice("reset option", key, OPTIONS)
        options = {key: value for key, value in (options or {}).items() if value is not None}
        if "scene" not in options:  # another scene has other targets
            options = {**self._only, **options}
        wanted = self._wanted if options.get("difficulty") is None else parse_difficulty(options["difficulty"])
        start = self._default_start if options.get("start") is None else self._start(options["start"])
        scene, tomato = options.get("scene"), options.get("target")
        if scene is None and tomato is not None:
            raise InvalidValueError("the reset option 'target' needs the option 'scene'")
        if scene is not None:
            scene = self._scene(scene)
        if tomato is not None:
            assert scene is not None
            index, difficulty = self._rate(scene, tomato)
            return Episode(scene, (index,), difficulty, start)
        names = _draw_difficulty(wanted, rng)
        if scene is None:
            scene, fitting = self._draw_scene(rng, names)
        elif not (fitting := self.fitting(scene, names)):
            raise InvalidValueError(self.nothing_fits(f"scene {scene.name!r}", names))
        target = fitting[int(rng.integers(len(fitting)))]
        return Episode(scene, (target.tomato,), self.rating(target), start)

    def targets(self, scene: Scene) -> list[int]:
        """Return the tomatoes of a scene that are rated with one of the chosen difficulties."""
        return [target.tomato for target in self.fitting(scene, tuple(self._wanted))]

    def _draw_scene(self, rng: np.random.Generator, names: tuple[str, ...]) -> tuple[Scene, list[Target]]:
        # rejection sampling keeps scenes equally likely without reading all of them
        for _ in range(_DRAWS):
            scene = self.bank.scene(self._window.draw(rng))
            if fitting := self.fitting(scene, names):
                return scene, fitting
        scenes = [scene for scene in map(self.bank.scene, self._names) if self.fitting(scene, names)]
        if not scenes:
            raise InvalidValueError(self.nothing_fits(f"split {self.split!r} of bank {self.bank.path}", names))
        scene = scenes[int(rng.integers(len(scenes)))]
        return scene, self.fitting(scene, names)

    def fitting(self, scene: Scene, names: tuple[str, ...]) -> list[Target]:
        """Return the targets of a scene with one of some difficulties, as rated for the arm, else for other arms."""
        key = (id(scene), names)
        if key not in self._cache:
            mine = [target for target in scene.targets if target.robot == self.robot.name]
            rated = mine or list({target.tomato: target for target in scene.targets}.values())
            self._cache[key] = (scene, [target for target in rated if target.difficulty in names])
        self._cache.move_to_end(key)
        while len(self._cache) > (self.at_a_time or _CACHED):
            self._cache.popitem(last=False)
        return self._cache[key][1]

    def _scene(self, scene: Any) -> Scene:
        if not isinstance(scene, (Scene, str)):
            raise InvalidValueError(f"scene must be a scene's name or a Scene, got {scene!r}")
        return self.bank.scene(scene) if isinstance(scene, str) else scene

    def rating(self, target: Target) -> str:
        """Return the difficulty of a target, or `UNRATED` if it is rated for another arm."""
        return str(target.difficulty) if target.robot == self.robot.name else UNRATED

    def nothing_fits(self, where: str, names: tuple[str, ...]) -> str:
        """Return the message for a scene or split without a target of some difficulties."""
        return (
            f"{where} has no target rated {' or '.join(names)} for robot {self.robot.name!r}; difficulties are "
            f"{', '.join(DIFFICULTIES)}"
        )

    def _rate(self, scene: Scene, tomato: Any) -> tuple[int, str]:
        count = scene.counts[0]
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
    """Return difficulties with their weights; all weights are 0 if none are given.

    Raises:
        UnknownNameError: A difficulty does not exist.
        InvalidValueError: No difficulty is given, or the weights are negative or all zero.
    """
    if isinstance(difficulty, np.ndarray):
        difficulty = difficulty.tolist()
    if not isinstance(difficulty, (str, Iterable)):
        raise InvalidValueError(
            f"difficulty must be one of {', '.join(DIFFICULTIES)}, several, or a weight for each, got {difficulty!r}"
        )
    if isinstance(difficulty, Mapping):
        weights = {require_choice("difficulty", name, DIFFICULTIES): _weight(w) for name, w in difficulty.items()}
        if not all(np.isfinite(w) and w >= 0 for w in weights.values()) or not any(weights.values()):
            raise InvalidValueError(f"difficulty weights must not be negative or all 0, got {dict(difficulty)}")
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
