"""Task `harvest`: pick ripe tomatoes and put them into a crate. It is the task of ``TomatoHarvest-v0``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.envs.episodes import Episode, EpisodeSampler
from greenhouse_gym.envs.features import FEATURES, MAX_OFFSET, Feature
from greenhouse_gym.envs.rewards import Transition
from greenhouse_gym.envs.state import Bools, State, lengths
from greenhouse_gym.envs.task import TARGET_FEATURES, Outcome, Task
from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Array, rotation_about
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import base_position
from greenhouse_gym.scene.plants.layout import ATTACHED, ROW_REACH, Layout
from greenhouse_gym.scene.plants.mechanics import PlantMechanics

RIPE = 0.6
"""Ripeness from which a tomato is picked."""

MATCHED = 0.02
"""Maximum distance of a reconstructed tomato from the true one that it stands for, metres."""

MAX_FORCE = 50.0
"""Bound of observed forces along each axis, N."""

MAX_PEDICEL = 0.2
"""Bound of the observed offset from a fruit to the joint it hangs or hung on, along each axis, metres."""

MOVING = 0.01
"""Joint speed above which a step counts as work, rad/s."""

_DRAWS = 256  # draws of an episode until one fits into the slots

SIZES: Mapping[str, Layout] = MappingProxyType(
    {"pick": Layout(1, 8, 8), "truss": Layout(1, 20, 8), "stand": Layout(4, 6, 8), "row": Layout(8, 6, 12)}
)
"""Sizes of the task with their slots: one fruit, all ripe fruit of a truss, those of up to four trusses, or all along
a row, whose slots move on with the cart."""

TOOLS = ("suction", "cutter")
"""Tools that hold a fruit, or cut a peduncle and hold the truss."""

STEP_LIMITS: Mapping[str, int] = MappingProxyType({"pick": 400, "truss": 4000, "stand": 6000, "row": 18000})
"""Steps after which an episode of each size is truncated: 20, 200, 300 and 900 s."""

COUNTED = ("detached", "crated", "dropped", "knocked", "damaged")
"""Counts of an episode, see `greenhouse_gym.envs.state.PLANTS`."""


@dataclass(frozen=True)
class HarvestReward:
    """Reward of a harvest.

    Attributes:
        crated: Reward for each fruit that comes to rest in the crate.
        detached: Reward for each fruit to be picked that comes off in the cup.
        dropped: Reward for each fruit that came off in the cup and was lost.
        knocked: Reward for each fruit that came off otherwise.
        damage: Reward for each organ that is damaged.
        collision: Reward for an episode that a contact or too much damage ends.
        progress: Reward per metre of progress of the fruit in work, from the tip to it and with it to the crate.
        time: Reward per step.
    """

    crated: float = 10.0
    detached: float = 2.0
    dropped: float = -5.0
    knocked: float = -5.0
    damage: float = -2.0
    collision: float = -5.0
    progress: float = 2.0
    time: float = -0.01

    def __call__(self, step: Transition) -> dict[str, Array]:
        """Return the terms of n steps."""
        start, end = step.start, step.end
        same = start.plants["work"] == end.plants["work"]
        return {
            "crated": self.crated * end.plants["crated"],
            "detached": self.detached * end.plants["detached"],
            "dropped": self.dropped * end.plants["dropped"],
            "knocked": self.knocked * end.plants["knocked"],
            "damage": self.damage * end.plants["damaged"],
            "collision": np.where(end.failure, self.collision, 0.0),
            "progress": np.where(same, self.progress * (step.before - step.after), 0.0),
            "time": np.full(len(step.after), self.time),
        }


def _bounds(*pairs: tuple[float, float]) -> tuple[Array, Array]:
    low, high = np.array(pairs).T
    return low, high


HARVEST_FEATURES: Mapping[str, Feature] = MappingProxyType(
    {
        **{name: FEATURES[name] for name in TARGET_FEATURES},
        "gripper": Feature(
            lambda s: np.stack([s.plants[name] for name in ("held", "vacuum", "hangs")], axis=1),
            lambda r: _bounds(*[(0, 1)] * 3),
        ),
        "wrist_force": Feature(lambda s: s.plants["force"], lambda r: _bounds(*[(-MAX_FORCE, MAX_FORCE)] * 3)),
        "fruit_radius": Feature(lambda s: s.plants["radius"][:, None], lambda r: _bounds((0, 0.2))),
        "fruit_left": Feature(lambda s: s.plants["left"][:, None], lambda r: _bounds((0, 1000 if r.on_rail else 100))),
        "pedicel": Feature(
            lambda s: s.plants["joint"] - s.plants["fruit"], lambda r: _bounds(*[(-MAX_PEDICEL, MAX_PEDICEL)] * 3)
        ),
        "crate_offset": Feature(
            lambda s: s.plants["crate"] - s.tip, lambda r: _bounds(*[(-MAX_OFFSET, MAX_OFFSET)] * 3)
        ),
    }
)
"""Features of the task: the fruit in work and its pedicel, the gripper, the force of the held fruit and the crate."""


@dataclass(frozen=True)
class TomatoHarvest(Task):
    """Pick the ripe tomatoes of a size of task and put them into the crate.

    Plants give way, fruit comes off when it is pulled and bent, and falls when the cup lets go. The task needs
    ``plants="compliant"`` and ``physics="truth"``.

    **Action.** As the setting ``action`` moves the arm, and a last entry for the tool: on above 0. With vacuum, the cup
    holds a fruit that it touches, up to a force of 18 N. A cutter within 6 mm of a peduncle's first piece cuts it and
    holds the whole truss, with its unripe fruit, up to 40 N, until it opens.

    **Observation.** With a cutter, the fruit in work is the truss: the point to cut, or the middle of the one that is
    held.

    **Success.** All fruit to be picked lie in the crate. An episode also ends, without success, when none of them is
    left to pick, when more than ``max_damage`` organs are damaged, when the arm touches itself or a fixture (floor,
    cart, crate, pipes and strings), and at the step limit.

    **Reward.** The terms of `HarvestReward`, in ``info["reward_terms"]``; ``sparse`` has ``crated`` alone.

    Attributes:
        size: "pick" (one fruit), "truss" (all ripe fruit of its truss), "stand" (the ripe fruit within reach of the
            ripest trusses, as many as have a slot) or "row" (the same along the rail of an arm of
            `greenhouse_gym.robots.mount_on_rail`, whose first joint drives arm and crate; slots move on to the fruit
            that come within reach).
        ripe: Ripeness from which a fruit is picked.
        max_damage: Number of damaged organs that an episode survives.
        layout: Slots for compliant plants, and the crate; None for those of the size.
        mechanics: Mechanics of the plants.
        tool: "suction", or "cutter" for whole trusses.
    """

    ends_on = ("fixture", "self")
    features = HARVEST_FEATURES
    rewards = MappingProxyType(
        {
            "dense": HarvestReward(),
            "sparse": HarvestReward(detached=0, dropped=0, knocked=0, damage=0, collision=0, progress=0, time=0),
        }
    )
    memory = MappingProxyType(dict.fromkeys(("wanted", "worked", *COUNTED), 0.0))

    controls = ("tool",)

    size: str = "pick"
    ripe: float = RIPE
    max_damage: int = 3
    layout: Layout | None = None
    mechanics: PlantMechanics = field(default=PlantMechanics())
    tool: str = "suction"

    def __post_init__(self) -> None:
        require_choice("size", self.size, SIZES)
        object.__setattr__(self, "step_limit", STEP_LIMITS[self.size])
        cutter = require_choice("tool", self.tool, TOOLS) == "cutter"
        object.__setattr__(self, "layout", replace(self.layout or SIZES[self.size], cutter=cutter))

    def holds(self, controls: Array) -> Bools:
        """Return a mask (n,) of the simulations whose tool is on."""
        return np.asarray(controls[:, 0] > 0)

    def sample(self, sampler: EpisodeSampler, rng: np.random.Generator, options: Mapping[str, Any] | None) -> Episode:
        """Draw a scene and the fruit to be picked; reset options may fix the scene and one of the fruit.

        Raises:
            InvalidValueError: No episode fits: no true ripe fruit is where the scan shows one, or they do not fit into
                the slots.
        """
        problem = ""
        for _ in range(_DRAWS):
            episode = sampler.draw(rng, options)
            if self.size == "row":
                _check_rail(sampler.robot, episode.scene)
            ripe = ripe_targets(episode.scene, self.ripe)
            fruit, problem = self._fruit(episode, sampler, ripe)
            if not problem:
                targets = sorted((k for k, one in ripe.items() if one in fruit), key=lambda k: k not in episode.targets)
                return replace(episode, targets=tuple(targets), fruit=fruit)
        raise InvalidValueError(f"no episode of size {self.size!r} in {_DRAWS} draws; the last: {problem}")

    def _fruit(self, episode: Episode, sampler: EpisodeSampler, ripe: Mapping[int, int]) -> tuple[tuple[int, ...], str]:
        """Return the fruit of an episode among those of the scene's truth, or the reason why it has no fruit."""
        scene = episode.scene
        anchor = ripe.get(episode.targets[0])
        if anchor is None and self.size != "row":
            where = f"scene {scene.name!r}, tomato {episode.targets[0]}"
            return (
                (),
                f"{where} is not ripe (from {self.ripe}) in the truth, or not within {1000 * MATCHED:.0f} mm of it",
            )
        if self.size == "pick" and anchor is not None:
            return (anchor,), ""
        assert self.layout is not None
        assert scene.truth is not None
        tomatoes = scene.truth.tomatoes
        if self.size == "truss" and anchor is not None:
            chosen = [tomatoes[anchor].truss]
            fruit = [k for k, t in enumerate(tomatoes) if t.truss in chosen and (t.ripeness or 0) >= self.ripe]
        else:
            along = self.size == "row"
            reachable = _along_rail(sampler.robot, scene) if along else set(sampler.targets(scene))
            within = [k for tomato, k in ripe.items() if tomato in reachable]
            trusses = Counter(tomatoes[k].truss for k in within)
            chosen = [truss for truss, count in trusses.most_common() if count <= self.layout.fruit]
            if not along or self.layout.cutter:  # otherwise slots move on along the row
                chosen = chosen[: self.layout.trusses]
            fruit = sorted(k for k in within if tomatoes[k].truss in chosen)
        largest = max((sum(t.truss == truss for t in tomatoes) for truss in chosen), default=0)
        ripest = max((sum(tomatoes[k].truss == truss for k in fruit) for truss in chosen), default=0)
        if not fruit or ripest > self.layout.fruit or largest > self.layout.fruit + ATTACHED:
            return (), (
                f"scene {scene.name!r}: trusses with {ripest} ripe of {largest} fruit do not fit into slots of "
                f"{self.layout.fruit}; choose another scene, another size or a larger layout"
            )
        return tuple(fruit), ""

    def evaluate(self, state: State) -> Outcome:
        """Return the outcome of n simulations."""
        plants = state.plants
        memory = {name: state.memory[name] + plants[name] for name in COUNTED}
        success = memory["crated"] >= plants["wanted"]
        failure = state.collided | (memory["damaged"] > self.max_damage) | ((plants["left"] == 0) & ~success)
        held = plants["held"] > 0
        to_crate = lengths(plants["crate"] - plants["fruit"])
        distance = np.where(held, 0.0, lengths(plants["fruit"] - state.tip)) + to_crate
        memory["wanted"] = plants["wanted"]
        memory["worked"] = state.memory["worked"] + (np.abs(state.velocities).max(axis=1) > MOVING)
        return Outcome(distance, success & ~failure, failure, memory=memory)


def _in_base(scene: Scene, robot: Robot, points: Array) -> Array:
    """Return points (n, 3) of a scene in the frame of an arm's base at the middle of its rail, metres."""
    return (points - base_position(scene, robot)) @ rotation_about([0, 0, 1], scene.placement.yaw)


def _along_rail(robot: Robot, scene: Scene) -> set[int]:
    """Return the tomatoes within reach from somewhere on the rail."""
    centers = _in_base(scene, robot, np.array([tomato.center for tomato in scene.tomatoes]))
    centers[:, 1] -= np.clip(centers[:, 1], robot.lower[0], robot.upper[0])
    centers[:, 2] -= robot.shoulder_height
    return set(np.flatnonzero(lengths(centers) < ROW_REACH).tolist())


def _check_rail(robot: Robot, scene: Scene) -> None:
    """Check that an arm slides along a row, and no farther than the row.

    Raises:
        InvalidValueError: It does not, or it slides beyond.
    """
    if not robot.on_rail:
        raise InvalidValueError(
            f"size 'row' needs an arm on a rail, and robot {robot.name!r} has none: "
            "greenhouse_gym.robots.mount_on_rail writes a copy of an arm on one"
        )
    arrays = (scene.truth or scene).arrays
    plants = _in_base(scene, robot, np.concatenate([arrays.starts, arrays.ends]))[:, 1]
    low, high = float(robot.lower[0]), float(robot.upper[0])
    if low < plants.min() or high > plants.max():
        raise InvalidValueError(
            f"the rail of robot {robot.name!r} leads from {low:.2f} to {high:.2f} m, beyond the row of scene "
            f"{scene.name!r} from {plants.min():.2f} to {plants.max():.2f} m: give mount_on_rail a shorter reach, or "
            "choose another scene"
        )


def ripe_targets(scene: Scene, ripe: float) -> dict[int, int]:
    """Return the ripe fruit of a scene's truth by the reconstructed tomatoes that stand for them.

    Raises:
        InvalidValueError: The scene carries no truth.
    """
    if scene.truth is None or not scene.truth.tomatoes:
        raise InvalidValueError(
            f"scene {scene.name!r} carries no truth, which a harvest needs: fruit comes off true plants; use a scene "
            "built from simulated recordings"
        )
    shown, true = (one.arrays.starts[: len(one.tomatoes)] for one in (scene, scene.truth))
    _, nearest = cKDTree(true).query(shown)
    is_ripe = np.nan_to_num(scene.truth.columns.ripeness) >= ripe
    matched = np.flatnonzero((lengths(true[nearest] - shown) <= MATCHED) & is_ripe[nearest])
    return dict(zip(matched.tolist(), nearest[matched].tolist(), strict=True))
