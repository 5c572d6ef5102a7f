"""Collision checks of configurations and motions, on the very model the simulator runs.

A configuration is free when MuJoCo reports no contact for it. Planning keeps a small margin on top: an obstacle
counts as touched from `MARGIN` metres on. A motion is checked at configurations so close together that no point of
the arm moves farther than a resolution between two of them; with the resolution `PROOF` = 2 * `MARGIN` every point of
the arm is at all times within a margin of a checked place that keeps this margin, which proves the motion free of
obstacles. Between the arm's own parts there is no margin: whether they touch is told at the checked configurations.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Iterable
from functools import cached_property, lru_cache
from itertools import pairwise

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.reach import arm_reaches, joint_reaches
from greenhouse_gym.scene.mjcf import CompiledScene

MARGIN = 0.005
"""Distance to obstacles that planning keeps, metres."""

PROOF = 2 * MARGIN
"""Resolution at which a path counts as proven free, metres."""

RESOLUTIONS = (6 * PROOF, 3 * PROOF, PROOF)
"""Resolutions at which planners check motions, metres; the next is used when a path of the one before is not free.

The first misses a collision in one search out of thirty, and needs half the checks of one that would miss none.
"""

COARSE = 0.05
"""Resolution at which a motion is looked at before anything is proven about it, metres."""


COLLISION_PAIRS = ("tomatoes", "stems", "clutter", "stand", "self")
"""What an arm can be checked against; the stand is the floor and the cart."""

CLEARANCE_RANGE = 0.1
"""Clearances beyond this are given as this, metres."""


def planning_model(
    compiled: CompiledScene, target: int, margin: float = MARGIN, pairs: Collection[str] = COLLISION_PAIRS
) -> mujoco.MjModel:
    """A copy of a scene's model in which the cup may touch the target and all obstacles are felt from a margin on.

    Args:
        compiled: The scene with its arm.
        target: Index of the target tomato.
        margin: Metres; 0 gives the simulator's own verdicts.
        pairs: What the arm is checked against, of `COLLISION_PAIRS`. The simulator checks all.

    Raises:
        InvalidValueError: The scene has no such tomato.
        UnknownNameError: No such pair.
    """
    count = len(compiled.scene.tomatoes)
    if not 0 <= target < count:
        raise InvalidValueError(f"target {target!r}: scene {compiled.scene.name!r} has tomatoes 0 to {count - 1}")
    model = _with_world_at_rest(compiled.model)
    compiled.allow_cup_on(model, target)
    set_margin(model, np.flatnonzero(model.geom_bodyid == 0), margin)
    for pair in pairs:
        require_choice("collision pair", pair, COLLISION_PAIRS)
    _leave_out(compiled, model, set(COLLISION_PAIRS) - set(pairs))
    return model


def checker_of(compiled: CompiledScene, target: int, pairs: Collection[str] = COLLISION_PAIRS) -> CollisionChecker:
    """The checker that planning for a target uses, with its margin."""
    return CollisionChecker(planning_model(compiled, target, pairs=pairs), arm_reaches(compiled.robot))


def _with_world_at_rest(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy whose kinematics leave out the geoms of the world body: MuJoCo places those once, when data are made.

    That is part of MuJoCo's sleeping, which puts nothing else to sleep as long as nothing is stepped. A scene of 300
    obstacles is then checked in two thirds of the time.
    """
    copied = copy.copy(model)
    copied.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    return copied


def _leave_out(compiled: CompiledScene, model: mujoco.MjModel, pairs: Collection[str]) -> None:
    """Let the arm pass through some kinds of things."""
    scene, first = compiled.scene, int(compiled.obstacle_geoms.start)
    world = np.flatnonzero(model.geom_bodyid == 0)
    tomatoes, stems, clutter = len(scene.tomatoes), len(scene.stems), len(scene.clutter)
    geoms = {
        "tomatoes": np.arange(first, first + tomatoes),
        "stems": np.arange(first + tomatoes, first + tomatoes + stems),
        "clutter": np.arange(first + tomatoes + stems, first + tomatoes + stems + clutter),
        "stand": world[(world < first) | (world >= compiled.obstacle_geoms.stop)],
        "self": np.empty(0, dtype=np.int64),
    }
    for pair in pairs:
        model.geom_contype[geoms[pair]] = model.geom_conaffinity[geoms[pair]] = 0
    if "self" in pairs:
        # obstacles offer contacts to the arm's affinity, and the arm offers none to itself
        model.geom_contype[model.geom_bodyid > 0] = 0


def path_clearance(compiled: CompiledScene, target: int, path: npt.ArrayLike) -> float:
    """Smallest distance of the arm to any obstacle but the target along a path (k, joints), up to `CLEARANCE_RANGE`.

    The floor and the cart do not count. Measured at configurations between which no point of the arm moves farther
    than 1 cm, in metres; negative inside an obstacle.
    """
    points = np.asarray(path, dtype=np.float64)
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(points, axis=0)) @ arm_reaches(compiled.robot))])
    places = np.linspace(0.0, way[-1], 1 + int(np.ceil(way[-1] / 0.01)))
    between = np.stack([np.interp(places, way, joint) for joint in points.T], axis=-1)
    return smallest_clearance(compiled, compiled.model, target, between)


def smallest_clearance(compiled: CompiledScene, model: mujoco.MjModel, target: int, configurations: Array) -> float:
    """Smallest distance of the arm to any obstacle but the target in some configurations, up to `CLEARANCE_RANGE`.

    The floor, the cart and the arm itself do not count.

    Args:
        compiled: The scene.
        model: Its model, or a copy in which the arm stands elsewhere.
        target: Index of the target tomato.
        configurations: (k, joints) radians.

    Returns:
        Metres; negative inside an obstacle.
    """
    model = _with_world_at_rest(model)
    set_margin(model, np.arange(compiled.obstacle_geoms.start, compiled.obstacle_geoms.stop), CLEARANCE_RANGE)
    _leave_out(compiled, model, ("stand", "self"))
    model.geom_contype[compiled.tomato_geom(target)] = model.geom_conaffinity[compiled.tomato_geom(target)] = 0
    checker = CollisionChecker(model)
    return min(CLEARANCE_RANGE, *(checker.clearance(configuration) for configuration in configurations))


def set_margin(model: mujoco.MjModel, geoms: npt.NDArray[np.int64], margin: float) -> None:
    """Let some geoms of the world body be felt from a distance on, in metres."""
    model.geom_margin[geoms] = margin
    # the compiler's maximum over a body's geoms, which the search for pairs of geoms goes by
    model.body_margin[0] = model.geom_margin[model.geom_bodyid == 0].max()


class CollisionChecker:
    """Tells free configurations and motions from colliding ones, and counts the checks.

    Args:
        model: The model, as `planning_model` makes it.
        reaches: Its `joint_reaches`, where they are known: they take 5 ms.

    Attributes:
        model: The model; do not change it.
        checks: Number of configurations checked so far.
    """

    def __init__(self, model: mujoco.MjModel, reaches: Array | None = None):
        self.checks = 0
        self._known_reaches = reaches
        self.model = model
        self._data = mujoco.MjData(model)
        self._qpos = self._data.qpos  # a view: writing to it costs a third of the attribute's lookup

    @cached_property
    def reaches(self) -> Array:
        """(joints,) bounds on the distance of the points that a joint moves from its axis, metres: `joint_reaches`."""
        return joint_reaches(self.model) if self._known_reaches is None else self._known_reaches

    def is_free(self, configuration: npt.ArrayLike) -> bool:
        """Whether nothing touches in a configuration (joints,)."""
        return self._all_free((configuration,))

    def motion_is_free(self, start: npt.ArrayLike, end: npt.ArrayLike, resolution: float) -> bool:
        """Whether the straight joint motion between two configurations, both included, is free.

        The verdict does not depend on the direction. Both ends are checked first, then the middle, the quarters, and
        so on: where there is a collision, it is found soon.
        """
        a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        return self._all_free((b, a)) and self.inside_is_free(a, b, resolution)

    def inside_is_free(self, start: Array, end: Array, resolution: float) -> bool:
        """As `motion_is_free`, for a motion whose ends are known to be free."""
        if tuple(start) > tuple(end):  # one direction for both, to the last bit
            start, end = end, start
        way = end - start
        return self._all_free(start + halving_order(self._steps(way, resolution)) * way)

    def _all_free(self, configurations: Iterable[npt.ArrayLike]) -> bool:
        """Whether all configurations are free; none after the first that is not is checked."""
        model, data, qpos = self.model, self._data, self._qpos  # in a loop this tight, looking them up counts
        kinematics, collision = mujoco.mj_kinematics, mujoco.mj_collision
        for configuration in configurations:
            self.checks += 1
            qpos[:] = configuration
            kinematics(model, data)
            collision(model, data)
            if data.ncon:
                return False
        return True

    def free_share(self, start: npt.ArrayLike, end: npt.ArrayLike, resolution: float) -> float:
        """The share of the straight motion from a free configuration up to which it is free, 0 to 1."""
        a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        steps = max(1, self._steps(b - a, resolution))
        for step in range(1, steps + 1):
            if not self.is_free(a + step / steps * (b - a)):
                return (step - 1) / steps
        return 1.0

    def path_is_free(self, path: npt.ArrayLike, resolution: float) -> bool:
        """Whether all motions of a path (k, joints) are free."""
        points = np.asarray(path, dtype=np.float64)
        if len(points) == 1:
            return self.is_free(points[0])
        return all(self.motion_is_free(a, b, resolution) for a, b in pairwise(points))

    def _steps(self, way: Array, resolution: float) -> int:
        return math.ceil(self.reaches @ np.abs(way) / resolution)

    def clearance(self, configuration: npt.ArrayLike) -> float:
        """Distance from the arm to what it may not touch, metres, negative inside; inf beyond the model's margin."""
        self.is_free(configuration)
        return float(self._data.contact.dist.min(initial=np.inf))

    def contacts(self, configuration: npt.ArrayLike) -> tuple[tuple[str, str], ...]:
        """Names of the pairs of geoms that touch in a configuration (or are within the model's margin)."""
        self.is_free(configuration)
        pairs = self._data.contact.geom
        return tuple((self.model.geom(int(a)).name, self.model.geom(int(b)).name) for a, b in pairs)


@lru_cache(maxsize=4096)
def halving_order(steps: int) -> Array:
    """The inner points of ``steps`` equal steps from 0 to 1 as (steps - 1, 1) shares: coarse ones first.

    The order is that of the bit-reversed index (van der Corput's sequence).
    """
    if steps < 2:
        return np.empty((0, 1))
    bits = int(steps - 1).bit_length()
    index = np.arange(1, 2**bits)
    reverse = np.zeros_like(index)
    for bit in range(bits):
        reverse |= ((index >> bit) & 1) << (bits - 1 - bit)
    order = reverse[reverse < steps]
    shares: Array = (order / steps)[:, None]
    shares.setflags(write=False)
    return shares
