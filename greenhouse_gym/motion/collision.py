"""Collision checks of configurations and motions, on the model that the simulator runs.

A configuration is free if MuJoCo reports no contact for it. Planning keeps a small margin in addition: an obstacle
nearer than `MARGIN` metres counts as a contact. A motion is checked at configurations between which no point of the arm
moves farther than a resolution; with the resolution `PROOF` = 2 * `MARGIN` every point of the arm is at all times
within a margin of its position in a checked configuration, which proves the motion free of obstacles. There is no
margin between the arm's own parts: their contacts are found at the checked configurations only.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TypeAlias

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.joint_reaches import joint_reaches
from greenhouse_gym.scene.mjcf import CompiledScene

MARGIN = 0.005
"""Distance that planning keeps from obstacles, metres."""

PROOF = 2 * MARGIN
"""Resolution at which a path counts as proven free, metres."""

RESOLUTIONS = (6 * PROOF, 3 * PROOF, PROOF)
"""Resolutions at which planners check motions, metres; the next is used if a path found with the one before collides.

The first misses a collision in one search out of thirty and needs half the checks of one that misses none.
"""

COARSE = 0.05
"""Resolution of first checks, before a motion is proven free, metres."""

COLLISION_PAIRS = ("tomatoes", "stems", "clutter", "fixture", "self")
"""Groups of geoms that an arm can be checked against; the fixture is the floor and the cart."""


LEAVES = ("rigid", "brush")
"""Treatments of leaves: they are obstacles, or give way to an arm that brushes them."""


Leaves: TypeAlias = str | npt.NDArray[np.int64]
"""One of `LEAVES`, or indices (k,) into the leaves of a scene of those that give way."""


def planning_model(
    compiled: CompiledScene,
    target: int,
    margin: float = MARGIN,
    pairs: Collection[str] = COLLISION_PAIRS,
    leaves: Leaves = LEAVES[0],
) -> mujoco.MjModel:
    """Copy a scene's model for planning: the cup may touch the target, and obstacles have a margin.

    Args:
        compiled: The scene with its arm.
        target: Index of the target tomato.
        margin: Metres; 0 gives the same contacts as the simulator.
        pairs: Groups of `COLLISION_PAIRS` to check the arm against. The simulator checks all.
        leaves: "rigid"; "brush" to let the arm pass through all leaves; or indices (k,) of the leaves that it may pass.

    Raises:
        InvalidValueError: The scene has no such tomato.
        UnknownNameError: No such pair, or no such treatment of leaves.
    """
    count = compiled.scene.counts[0]
    if not isinstance(target, int | np.integer) or isinstance(target, bool) or not 0 <= target < count:
        raise InvalidValueError(f"target {target!r}: scene {compiled.scene.name!r} has tomatoes 0 to {count - 1}")
    model = with_world_at_rest(compiled.model)
    compiled.allow_cup_on(model, target)
    set_margin(model, np.flatnonzero(model.geom_bodyid == 0), margin)
    for pair in pairs:
        require_choice("collision pair", pair, COLLISION_PAIRS)
    _leave_out(compiled, model, set(COLLISION_PAIRS) - set(pairs))
    pass_through(model, _yielding_geoms(compiled, leaves))
    return model


def _yielding_geoms(compiled: CompiledScene, leaves: Leaves) -> npt.NDArray[np.int64]:
    """Return the ids of the leaves that give way.

    Raises:
        InvalidValueError: There is no such leaf.
        UnknownNameError: No such treatment of leaves.
    """
    geoms = compiled.leaf_geoms
    if isinstance(leaves, str):
        return geoms if require_choice("leaves", leaves, LEAVES) == "brush" else geoms[:0]
    chosen = np.asarray(leaves)
    wrong = chosen[(chosen < 0) | (chosen >= len(geoms))] if chosen.dtype.kind in "iu" else chosen
    if chosen.ndim != 1 or (len(wrong) and len(chosen)):
        expected = f"scene {compiled.scene.name!r} has leaves 0 to {len(geoms) - 1}"
        raise InvalidValueError(f"leaves {', '.join(map(str, wrong.ravel()))}: {expected}")
    return geoms[chosen.astype(np.int64)]


def with_world_at_rest(model: mujoco.MjModel) -> mujoco.MjModel:
    """Copy a model so that its kinematics skip the geoms of the world body, which MuJoCo places once per `MjData`.

    This is part of MuJoCo's sleeping, which affects nothing else as long as nothing is stepped. Checks of a scene with
    300 obstacles take two thirds of the time.
    """
    copied = copy.copy(model)
    copied.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    return copied


def pass_through(model: mujoco.MjModel, geoms: npt.NDArray[np.int64]) -> None:
    """Let the arm pass through some geoms of the world body."""
    model.geom_contype[geoms] = model.geom_conaffinity[geoms] = 0


def _leave_out(compiled: CompiledScene, model: mujoco.MjModel, pairs: Collection[str]) -> None:
    """Let the arm pass through some groups of geoms."""
    scene, first = compiled.scene, int(compiled.obstacle_geoms.start)
    world = np.flatnonzero(model.geom_bodyid == 0)
    tomatoes, stems, clutter = scene.counts
    geoms = {
        "tomatoes": np.arange(first, first + tomatoes),
        "stems": np.arange(first + tomatoes, first + tomatoes + stems),
        "clutter": np.arange(first + tomatoes + stems, first + tomatoes + stems + clutter),
        "fixture": world[(world < first) | (world >= compiled.obstacle_geoms.stop)],
        "self": np.empty(0, dtype=np.int64),
    }
    for pair in pairs:
        pass_through(model, geoms[pair])
    if "self" in pairs:
        # obstacles offer contacts to the arm's affinity, and the arm offers none to itself
        model.geom_contype[model.geom_bodyid > 0] = 0


def clearance_model(
    compiled: CompiledScene, model: mujoco.MjModel, target: int, leaves: str = LEAVES[0]
) -> mujoco.MjModel:
    """Copy a model so that only contacts of the arm with obstacles other than a target count.

    With ``leaves="brush"``, leaves do not count either.
    """
    model = with_world_at_rest(model)
    _leave_out(compiled, model, ("fixture", "self"))
    ignored = [compiled.tomato_geom(target), *(compiled.leaf_geoms if leaves == "brush" else ())]
    pass_through(model, np.array(ignored))
    return model


def set_margin(model: mujoco.MjModel, geoms: npt.NDArray[np.int64], margin: float) -> None:
    """Set the distance at which contacts with some geoms of the world body are found and push, metres."""
    model.geom_margin[geoms], model.geom_gap[geoms] = margin, 0.0
    # the broad phase uses the compiler's maximum over a body's geoms
    model.body_margin[0] = model.geom_margin[model.geom_bodyid == 0].max()


class CollisionChecker:
    """Collision checker of configurations and motions, which counts its checks.

    Args:
        model: The model, as `planning_model` returns it.
        reaches: Its `joint_reaches`, if known: they take 5 ms to compute.

    Attributes:
        model: The model; do not change it.
        checks: Number of configurations checked so far.
    """

    def __init__(self, model: mujoco.MjModel, reaches: Array | None = None):
        self.checks = 0
        self._known_reaches = reaches
        self.model = model

    @cached_property
    def _data(self) -> mujoco.MjData:
        return mujoco.MjData(self.model)

    @cached_property
    def _qpos(self) -> Array:
        return self._data.qpos  # a view: writing to it takes a third of the time of looking it up

    @cached_property
    def reaches(self) -> Array:
        """Largest motion of any point of the arm per radian of each joint, (joints,) metres: `joint_reaches`."""
        return joint_reaches(self.model) if self._known_reaches is None else self._known_reaches

    def is_free(self, configuration: npt.ArrayLike) -> bool:
        """Return whether a configuration (joints,) is collision-free."""
        return self._all_free(np.asarray(configuration, dtype=np.float64)[None])

    def are_free(self, configurations: Array) -> npt.NDArray[np.bool_]:
        """Return whether each of some configurations (k, joints) is collision-free, (k,)."""
        return np.array([self.is_free(configuration) for configuration in configurations], dtype=np.bool_)

    def motion_is_free(self, start: npt.ArrayLike, end: npt.ArrayLike, resolution: float) -> bool:
        """Return whether the straight joint motion between two configurations, both included, is collision-free.

        The result does not depend on the direction. Both ends are checked first, then the middle, the quarters, and so
        on, so that a collision is found soon.
        """
        return self._all_free(self._along(start, end, resolution), resolution)

    def inside_is_free(self, start: Array, end: Array, resolution: float) -> bool:
        """Return whether a motion between free ends is free, without checking the ends."""
        return self._all_free(self._along(start, end, resolution)[2:], resolution)

    def motions_are_free(
        self, starts: Array, ends: Array, resolution: float, inside: bool = False
    ) -> npt.NDArray[np.bool_]:
        """Return whether each of some motions between configurations (k, joints) is free, (k,).

        With ``inside``, their ends are known to be free.
        """
        check = self.inside_is_free if inside else self.motion_is_free
        return np.array([check(a, b, resolution) for a, b in zip(starts, ends, strict=True)], dtype=np.bool_)

    def _along(self, start: npt.ArrayLike, end: npt.ArrayLike, resolution: float) -> Array:
        """Return the configurations (k, joints) to be checked on a motion, its ends first."""
        a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        first, last = (b, a) if tuple(a) > tuple(b) else (a, b)  # so that results are equal to the last bit
        motion = last - first
        fractions = halving_order(self._steps(motion, resolution))
        configurations = np.empty((2 + len(fractions), len(a)))
        configurations[0], configurations[1] = b, a
        np.add(first, fractions * motion, out=configurations[2:])
        return configurations

    def _all_free(self, configurations: Array, resolution: float = math.inf) -> bool:
        """Return whether all configurations (k, joints) are collision-free; stop at the first collision.

        They are as far apart as the resolution allows, metres.
        """
        data = self._data
        for configuration in configurations:
            self._collide(configuration)
            if data.ncon:
                return False
        return True

    def _collide(self, configuration: npt.ArrayLike) -> None:
        """Let MuJoCo find the contacts of a configuration."""
        self.checks += 1
        self._qpos[:] = configuration
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_collision(self.model, self._data)

    def free_fraction(self, start: npt.ArrayLike, end: npt.ArrayLike, resolution: float) -> float:
        """Return the fraction of the straight motion from a free configuration up to the first collision, 0 to 1."""
        a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        steps = max(1, self._steps(b - a, resolution))
        for step in range(1, steps + 1):
            if not self.is_free(a + step / steps * (b - a)):
                return (step - 1) / steps
        return 1.0

    def path_is_free(self, path: npt.ArrayLike, resolution: float) -> bool:
        """Return whether all motions of a path (k, joints) are free."""
        points = np.asarray(path, dtype=np.float64)
        if len(points) == 1:
            return self.is_free(points[0])
        return all(self.motion_is_free(a, b, resolution) for a, b in pairwise(points))

    def _steps(self, motion: Array, resolution: float) -> int:
        return math.ceil(self.reaches @ np.abs(motion) / resolution)

    def clearance(self, configuration: npt.ArrayLike) -> float:
        """Return the distance of the arm to the nearest contact, metres; < 0 inside, inf beyond the model's margin."""
        self._collide(configuration)
        return float(self._data.contact.dist.min(initial=np.inf))

    def contacts(self, configuration: npt.ArrayLike) -> list[tuple[int, int]]:
        """Return the pairs of geoms in contact, or within the model's margin, in a configuration."""
        self._collide(configuration)
        return [(int(a), int(b)) for a, b in self._data.contact.geom]


@lru_cache(maxsize=4096)
def halving_order(steps: int) -> Array:
    """Return the inner points of ``steps`` equal steps from 0 to 1 as fractions (steps - 1, 1), coarse ones first.

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
    fractions: Array = (order / steps)[:, None]
    fractions.setflags(write=False)
    return fractions
