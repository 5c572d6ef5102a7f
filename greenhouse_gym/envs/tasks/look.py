"""Task `look`: find the ripe fruit of a stand with the camera at the wrist. It is the task of ``TomatoLook-v0``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.envs.episodes import Episode, EpisodeSampler
from greenhouse_gym.envs.features import Feature
from greenhouse_gym.envs.rewards import SparseReward, Transition
from greenhouse_gym.envs.state import Bools, State
from greenhouse_gym.envs.task import Outcome, Task
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, transform
from greenhouse_gym.motion.voxel_map import VoxelBox
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.scene.obstacles import MAX_TOMATOES, Shapes
from greenhouse_gym.scene.occupancy import FREE, OCCUPIED, UNKNOWN

if TYPE_CHECKING:
    from greenhouse_gym.envs.views import View
    from greenhouse_gym.envs.world import World

RIPE = 3
"""State of a cell with the skin of ripe fruit, besides `UNKNOWN`, `FREE` and `OCCUPIED`."""

MAP = VoxelBox((0.1, -1.2, -0.76), (25, 60, 40), 0.04)
"""The carved map: the plants within an arm's reach."""

MIN_DEPTH = 0.1
"""Smallest depth at which fruit is recognized, metres."""

REPORTED_VIEWS = (1, 3, 5, 10)
"""Numbers of views after which the fraction of the ripe fruit found is reported."""

_DRAWS, _MANY = 64, 1000.0


@dataclass(frozen=True)
class LookReward:
    """Reward ``dense`` of `TomatoLook`.

    Attributes:
        found: Reward for all ripe fruit of the stand, in proportion to the fraction found in a step.
        view: Reward per view: by default it costs as much as a step, the time to take and read it.
        time: Reward per step.
        collision: Reward for a collision.
    """

    found: float = 10.0
    view: float = -0.02
    time: float = -0.02
    collision: float = -5.0

    def __call__(self, step: Transition) -> dict[str, Array]:
        """Return the terms of n steps."""
        before, after = step.start.memory, step.end.memory
        return {
            "found": self.found * (after["fraction"] - before["fraction"]),
            "view": self.view * (after["views"] - before["views"]),
            "time": np.full(len(step.after), self.time),
            "collision": np.where(step.collided, self.collision, 0.0),
        }


@dataclass(frozen=True)
class TomatoLook(Task):
    """Find all ripe fruit of a stand with the camera at the wrist, soon, and touch nothing.

    **View.** The last entry of an action, ``look``, takes a view if it is above 0: a depth image at the end of the
    action, in which every fruit is recognized. Other actions only move the arm.

    **Found.** A ripe fruit is found once at least 10 % of its silhouette (``min_visible``) is in the image and hidden
    by nothing, at a depth of 0.1 to 1.2 m (``max_range``). Ten percent is the visibility from which the BOP benchmark
    expects an object to be detected (Hodaň et al., 2020). Fruit is ripe from a ripeness of 0.7 on (``ripe``), or if
    its ripeness is unknown.

    **Map.** Views carve `MAP`, cells of 4 cm in the base frame, from unknown to free, occupied or ripe skin; they start
    unknown. ``observation="task"`` contains it as ``map`` (25, 60, 40), next to the ``state`` of the arm with the
    numbers of views and of fruit found so far. Agents know neither the scan nor the number of ripe fruit; the other
    observations of `GreenhouseEnv` work as well, but clearances in them are those of the scan.

    **End.** Success is all ripe fruit found. Every contact is a collision, which ends the episode as a failure.

    **Reward** ``dense``: +10 for all ripe fruit, in proportion to the fraction found in the step (``found``), -0.02 per
    view (``view``) and per step (``time``), -5 for a collision (``collision``). ``sparse``: +1 and -1.

    **Info**: ``ripe``, ``found``, ``fraction`` of the ripe fruit found, ``views``, and ``fraction_1``, ``fraction_3``,
    ``fraction_5`` and ``fraction_10`` after that many views, or so far. ``distance`` is the fraction that is left.

    Attributes:
        min_visible: Smallest visible fraction of a fruit's silhouette at which it is found.
        max_range: Largest depth at which it is found, metres.
        ripe: Smallest ripeness of a fruit that counts.
        camera: The camera.
    """

    min_visible: float = 0.1
    max_range: float = 1.2
    ripe: float = 0.7
    camera: DepthCamera = field(default_factory=DepthCamera)

    controls = ("look",)
    allows_cup_contact = False
    knows_scan = False
    features = MappingProxyType(
        {
            "views": Feature(lambda s: s.memory["views"][:, None], lambda r: (np.zeros(1), np.full(1, _MANY))),
            "found": Feature(lambda s: s.memory["found"][:, None], lambda r: (np.zeros(1), np.full(1, _MANY))),
        }
    )
    rewards = MappingProxyType({"dense": LookReward(), "sparse": SparseReward()})
    arrays = MappingProxyType({"map": spaces.Box(UNKNOWN, RIPE, MAP.shape, dtype=np.uint8)})
    memory = MappingProxyType(
        {
            "ripe": 0, "found": 0, "fraction": 0.0, "views": 0, **{f"fraction_{k}": 0.0 for k in REPORTED_VIEWS},
            "map": np.full(MAP.shape, UNKNOWN, dtype=np.uint8),
            "_ripe": np.zeros(MAX_TOMATOES, dtype=np.bool_), "_found": np.zeros(MAX_TOMATOES, dtype=np.bool_),
        }
    )  # fmt: skip

    def __post_init__(self) -> None:
        for name, low, high in (("min_visible", 0.0, 1.0), ("max_range", MIN_DEPTH, 10.0), ("ripe", -1.0, 1.0)):
            value = getattr(self, name)
            if not low < value <= high:
                raise InvalidValueError(f"TomatoLook {name} must be above {low:g} up to {high:g}, got {value!r}")

    def sample(self, sampler: EpisodeSampler, rng: np.random.Generator, options: Mapping[str, Any] | None) -> Episode:
        """Draw a scene with ripe fruit, in the reconstruction and, if known, in the truth."""
        for _ in range(_DRAWS):
            episode = sampler.draw(rng, options)
            scene = episode.scene
            if self._is_ripe(scene).any() and (scene.truth is None or self._is_ripe(scene.truth).any()):
                return episode
        raise InvalidValueError(
            f"no ripe fruit to look for: not in {_DRAWS} scenes drawn, the last {episode.scene.name!r}; choose another "
            f"scene, split or bank, or a TomatoLook with ripe below {self.ripe:g}"
        )

    def _is_ripe(self, shapes: Shapes) -> Bools:
        """Return a mask (t,) of the ripe tomatoes."""
        return np.array([each.ripeness is None or each.ripeness >= self.ripe for each in shapes.tomatoes], dtype=bool)

    def begin(self, world: World) -> Mapping[str, npt.ArrayLike]:
        """Return the ripe fruit of a simulated world."""
        ripe = self._is_ripe(world.compiled.scene)
        return {"ripe": ripe.sum(), "_ripe": np.pad(ripe, (0, MAX_TOMATOES - len(ripe)))}

    def looks(self, controls: Array) -> Bools:
        """Return a mask (n,) of the simulations whose entry ``look`` is above 0."""
        return np.asarray(controls[:, 0] > 0)

    def see(self, view: View, memory: Mapping[str, Any]) -> Mapping[str, npt.ArrayLike]:
        """Return the fruit found by a view, and the map carved by it."""
        ripe, found = np.flatnonzero(memory["_ripe"]), memory["_found"].copy()
        found[ripe] |= view.visible_fractions(ripe, (MIN_DEPTH, self.max_range)) >= self.min_visible
        fraction, views = found.sum() / len(ripe), memory["views"] + 1
        fractions = {f"fraction_{k}": fraction for k in REPORTED_VIEWS if views <= k}
        chart = carved(memory["map"], view, memory["_ripe"])
        return {"_found": found, "found": found.sum(), "fraction": fraction, "views": views, "map": chart, **fractions}

    def evaluate(self, state: State) -> Outcome:
        """Return the fraction of the ripe fruit that is left, success and collisions."""
        fraction = state.memory["fraction"]
        return Outcome(1.0 - fraction, (fraction >= 1.0) & ~state.collided, state.collided.copy())


def carved(chart: npt.NDArray[np.uint8], view: View, ripe: Bools) -> npt.NDArray[np.uint8]:
    """Return the map (`MAP.shape`) after a view: surfaces stay, and unknown cells in front of them become free.

    Args:
        chart: The map before.
        view: The view.
        ripe: (t,) which tomatoes are ripe.
    """
    cells, rays, origin = chart.reshape(-1).copy(), view.camera.rays, view.pose[:3, 3]
    turned = (rays[:, None, :] * view.pose[:3, :3]).sum(axis=-1)
    through = MAP.looked_through(origin, turned, view.reading.free.reshape(-1) - MAP.cell / 2)
    cells[through & (cells == UNKNOWN)] = FREE
    surface = (view.reading.depth > 0) & ~view.on_arm
    points = transform(view.pose, rays[surface.reshape(-1)] * view.reading.depth[surface][:, None])
    hit, tomato = MAP.indices(points), view.tomato[surface]
    cells[hit[(hit >= 0) & (cells[hit] != RIPE)]] = OCCUPIED
    cells[hit[(hit >= 0) & (tomato >= 0) & ripe[tomato]]] = RIPE
    return cells.reshape(chart.shape)
