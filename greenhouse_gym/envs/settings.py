"""Settings of an environment, the same for the single and the vector environment."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from greenhouse_gym import ENV_IDS
from greenhouse_gym.common.own_code import described, load_own, with_absolute_path
from greenhouse_gym.envs.actions import ActionChoice
from greenhouse_gym.envs.episodes import DifficultyChoice, parse_difficulty
from greenhouse_gym.envs.observations import ObservationChoice
from greenhouse_gym.envs.randomization import NO_RANDOMIZATION, Randomization
from greenhouse_gym.envs.rewards import Reward
from greenhouse_gym.envs.state import RATE, control_timing
from greenhouse_gym.envs.task import Task
from greenhouse_gym.errors import InvalidValueError, UnknownKeywordError, check_whole, is_number, require_choice
from greenhouse_gym.geometry import numbers_of
from greenhouse_gym.motion.success import SUCCESS_RADIUS
from greenhouse_gym.robots import ROBOTS, Robot, get_robot
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.manifest import SPLITS
from greenhouse_gym.scene.mjcf import MAX_CAPACITY, TIMESTEP

INFOS = ("all", "numbers")
"""Choices of infos."""

PHYSICS = ("reconstruction", "truth")
"""Choices of the simulated world."""

PLANTS = ("rigid", "brush", "compliant")
"""Choices of the mechanics of plants."""


@dataclass(frozen=True)
class EnvSettings:
    """Settings of an environment; every field is also a keyword of ``gymnasium.make`` and ``make_vec``.

    Attributes:
        bank: Name of a shipped bank, folder of one, or a `SceneBank`. Episodes of a split with more than 300 scenes are
            drawn from a few scenes at a time (`SceneWindow`); the seed of a reset restarts their order.
        split: "train", "validation" or "test".
        robot: Name of a shipped arm ("ur5e", "iiwa14"), an MJCF file, or a `Robot` of `load_robot`.
        observation: "state", "state_occupancy", "roadmap", "task", "goal", "goal_roadmap",
            "depth", "points", "rgb", "rgbd", settings of the last four, or your own `Observation`. Everything of your
            own is an object, ``"file.py:Name"``, ``"module:Name"``, or a mapping with such a name as ``class`` and its
            fields.
        action: "joint", "joint_velocity", "tip_velocity", or your own `ActionRule`.
        reward: "dense", "sparse", "path", a `DenseReward`, `SparseReward` or `PathReward` with other values, or your
            own function from a `Transition` to terms.
        difficulty: Difficulty of the targets: one, several (at their natural frequency), or a weight for each, such as
            ``{"easy": 1, "hard": 3}``. "unreachable" targets must be named. `set_difficulty` changes it. If a scene is
            not rated for the arm, the ratings for other arms are used and reported as "unrated".
        physics: "reconstruction" simulates the scene; "truth" simulates the true row behind it, with the tomato nearest
            to the target as the goal, while observations still show the reconstruction.
        plants: "rigid", or "brush" for leaves that give way: contacts with them are found and counted, but neither stop
            the arm nor end the episode; see `GreenhouseEnv`. Leaves are all clutter except gutters, see
            `greenhouse_gym.crops.parts.is_leaf`; fruit, stems, fixtures and the arm itself stay rigid. "compliant",
            with ``physics="truth"``: trusses of the targets and the leaves around them give way and push back, other
            leaves are as with "brush".
        randomization: Domain randomization; none by default.
        capacity: Maximum number of obstacles of a scene; if None, 600 or as many as the largest scene of the bank has.
        success_radius: Maximum distance of the grasp point from the target's center for a success, metres. It belongs
            to the task "reach"; your own task has its own settings.
        step_limit: Steps after which an episode is truncated; None for that of the task, 200 except for harvests.
        start: Start configuration: the name of one of the arm's, "ready", "upright" or "folded", or a joint angle for
            each joint, radians; the arm's own if None, which is "ready". The options of a reset may choose another.
            Where the arm's own would touch true plants that stop it, the episode begins from "upright".
        rate: Actions per second; the time between two actions must be a multiple of 10 ms: 100, 50, 25, 20, 10 and so
            on. Joint actions have the same maximum speed at every rate.
        task: Task: "reach", "look", "harvest", your own as ``"file.py:Name"`` or ``"module:Name"``, a `Task` or a
            subclass of it.
        scene: The only scene of all episodes: its name, of any split, or a `Scene`; if None, each episode draws one.
        target: Index of its only target tomato; if None, each episode draws one of the scene's.
        infos: "all", or "numbers" for libraries that read no texts and no nested infos, such as TorchRL: texts are left
            out, and keys are those of one level, such as "reward_terms.progress".
        size: Size of the task "harvest": "pick", "truss", "stand" or "row"; its default if None.
    """

    bank: str | Path | SceneBank = "default"
    split: str = "train"
    robot: str | Path | Robot = "ur5e"
    observation: ObservationChoice | Mapping[str, Any] = "state"
    action: ActionChoice | Mapping[str, Any] = "tip_velocity"
    reward: str | Reward | Mapping[str, Any] = "dense"
    difficulty: DifficultyChoice = ("easy", "medium", "hard")
    physics: str = "reconstruction"
    plants: str = "rigid"
    randomization: Randomization = field(default=NO_RANDOMIZATION)
    capacity: int | None = None
    success_radius: float = SUCCESS_RADIUS
    step_limit: int | None = None
    rate: float = RATE
    start: str | Sequence[float] | None = None
    task: str | Task | type[Task] | Mapping[str, Any] = "reach"
    scene: str | Scene | None = None
    target: int | None = None
    infos: str = "all"
    size: str | None = None

    def __post_init__(self) -> None:
        _check_kind("bank", self.bank, (str, Path, SceneBank), "a bank's name, folder or SceneBank")
        _check_kind("robot", self.robot, (str, Path, Robot), "an arm's name, MJCF file or Robot")
        object.__setattr__(self, "randomization", load_own(self.randomization, "randomization"))
        _check_kind("randomization", self.randomization, Randomization, "a Randomization")
        require_choice("split", self.split, SPLITS)
        require_choice("physics", self.physics, PHYSICS)
        require_choice("plants", self.plants, PLANTS)
        require_choice("infos", self.infos, INFOS)
        parse_difficulty(self.difficulty)
        if self.capacity is not None:
            check_whole("capacity", self.capacity, 1, MAX_CAPACITY)
        if self.plants == "compliant" and self.physics != "truth":
            raise InvalidValueError(
                'plants="compliant" needs physics="truth", because only true plants have a topology'
            )
        if self.step_limit is not None:
            check_whole("step_limit", self.step_limit, 1)
        kinds = (str, Task, Mapping)
        if not isinstance(self.task, kinds) and not (isinstance(self.task, type) and issubclass(self.task, Task)):
            raise InvalidValueError(f"task must be a name, a Task or a subclass of Task, got {self.task!r}")
        for name in ("observation", "action", "reward", "task"):
            object.__setattr__(self, name, with_absolute_path(getattr(self, name)))
        if self.scene is None and self.target is not None:
            raise InvalidValueError(f"target needs scene, the scene of the tomato, got target={self.target!r} alone")
        if not is_number(self.success_radius) or not 0 < self.success_radius <= 1:
            raise InvalidValueError(f"success_radius must be metres above 0 up to 1, got {self.success_radius!r}")
        if self.start is not None and not isinstance(self.start, str):
            object.__setattr__(self, "start", _numbers("start", self.start))
        if not is_number(self.rate) or not 0.1 <= self.rate <= 1 / TIMESTEP or not _divides(self.rate):
            raise InvalidValueError(
                f"rate must be {1 / TIMESTEP:g} actions per second divided by a whole number (100, 50, 25, 20, ...), "
                f"got {self.rate!r}"
            )

    def agent_options(self) -> dict[str, Any]:
        """Return the keywords of an environment with the same arm (its name or file), spaces and task."""
        options: dict[str, Any] = {
            "robot": _as_json(get_robot(self.robot)),
            "observation": self.observation,
            "action": self.action,
        }
        if self.rate != RATE:
            options["rate"] = self.rate
        if self.task != "reach":
            options["task"] = self.task
        if self.plants == "compliant":
            options |= {"plants": self.plants, "physics": self.physics}
        return options

    def keywords(self) -> dict[str, Any]:
        """Return the keywords of ``gymnasium.make`` that differ from the defaults, as JSON values where possible."""
        plain = EnvSettings()
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        changed = {name: _as_json(value) for name, value in given.items() if value != getattr(plain, name)}
        return {**changed, "scene": self._scene_by_name()} if self.scene is not None else changed

    def __reduce__(self) -> tuple[Any, ...]:
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        return _restored, ({**given, "scene": self._scene_by_name()},)

    def _scene_by_name(self) -> str | Scene | None:
        """Return the name of the scene if it is the bank's."""
        scene, bank = self.scene, SceneBank.open(self.bank)
        known = isinstance(scene, Scene) and scene.name in bank.names() and bank.scene(scene.name) is scene
        return scene.name if known else scene  # type: ignore[union-attr]

    def spec(self) -> EnvSpec:
        """Return the specification with which ``gymnasium.make`` makes an environment with these settings.

        It names the action even if that is the default, because recorded actions outlive defaults.
        """
        found = copy.copy(gymnasium.spec(ENV_IDS[0]))
        found.kwargs = {"action": described(self.action), **self.keywords()}
        return found


def _restored(given: dict[str, Any]) -> EnvSettings:
    return EnvSettings(**given)


def _as_json(value: Any) -> Any:
    """Return a setting as a JSON value if possible, else unchanged."""
    if isinstance(value, SceneBank):
        return str(value.path)
    if isinstance(value, Robot):
        return value.name if value.name in ROBOTS else str(value.path)
    if isinstance(value, Path | np.generic):
        return str(value) if isinstance(value, Path) else value.item()
    return described(value) if not isinstance(value, Sequence | Scene) else value


def settings_with(callee: str, settings: EnvSettings | None, keywords: Mapping[str, Any]) -> EnvSettings:
    """Return settings (default ones if None) with some fields replaced.

    Args:
        callee: Name of the caller, for messages.
        settings: Settings.
        keywords: New values by field.

    Raises:
        UnknownKeywordError: A keyword is not a field; the message lists the fields.
        InvalidValueError: ``settings`` is not an `EnvSettings`, or a value is invalid.
    """
    names = [f.name for f in fields(EnvSettings)]
    for name in keywords:
        if name not in names:
            near = get_close_matches(name, names, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise UnknownKeywordError(
                f"{callee}() got an unexpected keyword argument {name!r}.{hint} Choices: {', '.join(names)}"
            )
    if settings is not None:
        _check_kind("settings", settings, EnvSettings, "an EnvSettings")
    return replace(settings or EnvSettings(), **keywords)


def _check_kind(name: str, value: Any, kinds: type | tuple[type, ...], expected: str) -> None:
    if not isinstance(value, kinds):
        raise InvalidValueError(f"{name} must be {expected}, got {value!r}")


def _numbers(name: str, value: Any) -> tuple[float, ...]:
    numbers = numbers_of(value)
    if numbers.ndim != 1 or not numbers.size or not np.isfinite(numbers).all():
        raise InvalidValueError(f"{name} must be a name or numbers, got {value!r}")
    return tuple(numbers.tolist())


def _divides(rate: float) -> bool:
    return abs(control_timing(rate).interval * rate - 1.0) < 1e-9
