"""Goal configurations: configurations of the arm with the grasp point on the target's center.

Random guesses are brought onto the target by inverse kinematics (damped least squares; Wampler 1986). Planning searches
the whole joint space: it keeps guesses whose grasp point lies within a threshold of the target and drops
near-duplicates, as in "Simulation of a robotics operation" in the paper this package follows. The roadmap wants goals
near the start, so it draws guesses within half a turn of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError, check_whole, is_number, require_seed
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import LEAVES, CollisionChecker, Leaves
from greenhouse_gym.motion.inverse_kinematics import Approach, inverse_kinematics
from greenhouse_gym.motion.proof import ProvingChecker, checker_of
from greenhouse_gym.motion.unknown_space import depths_of, guarded
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.robots.kinematics import tool_chain
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import CompiledScene

SAMPLE_BUDGET = 40_000
"""Number of random configurations after which the search gives up."""

CAREFUL_BUDGET = 5_000
"""Number of random configurations if the arm avoids unknown space: many tomatoes then have no goal at all."""

BATCH_SIZE = 1000
"""Random configurations drawn at a time over the whole joint space."""

LOCAL_BATCH_SIZE = 300
"""Random configurations drawn at a time near the start."""

MIN_GOALS, MAX_GOALS = 20, 60
"""Free goals near the start: with fewer than the first number, more are sampled; no more than the second are used."""

BATCHES, MAX_BATCHES = 4, 24
"""Batches sampled to get `MIN_GOALS`, and batches sampled while there is no free goal at all."""


@dataclass(frozen=True)
class GoalStatistics:
    """Counts of a goal search.

    Attributes:
        samples: Random configurations drawn.
        within_threshold: Those with the grasp point within the threshold of the target.
        converged: Those that inverse kinematics brought onto the target within the joint limits, and into the approach
            cone if one is given.
        duplicate: Converged, free ones that repeat an accepted one.
        colliding: Converged ones in collision.
    """

    samples: int
    within_threshold: int
    converged: int
    duplicate: int
    colliding: int


@dataclass(frozen=True, eq=False)
class Goals:
    """Goal configurations for one target.

    Attributes:
        configurations: (k, joints) radians, in the order found; k = 0 if none exists.
        statistics: Counts of the search.
    """

    configurations: Array
    statistics: GoalStatistics


class GoalBatch(NamedTuple):
    """Result of one batch of random guesses.

    Attributes:
        within_threshold: Number of guesses that inverse kinematics was tried on.
        configurations: (k, joints) configurations on the target, whether or not they collide, radians.
    """

    within_threshold: int
    configurations: Array


class GoalSampler:
    """Random configurations with the grasp point on a target, batch by batch, not checked for collisions.

    Each batch is computed once, so all who index the sampler get the same configurations.

    Args:
        compiled: The scene with its arm.
        target: Index of the target tomato.
        start: (joints,) configuration that guesses lie within half a turn of, with its tool roll, radians; the whole
            joint space when left out.
        center: (3,) assumed center of the target in the scene, metres; its true center when left out.
        threshold: Guesses with the grasp point farther from the target than this are dropped, metres.
        approach: Directions the tool may come from; any when left out.
        seed: Seed of the guesses.
    """

    def __init__(
        self,
        compiled: CompiledScene,
        target: int,
        start: Array | None = None,
        center: Array | None = None,
        threshold: float = math.inf,
        approach: Approach | None = None,
        seed: int = 0,
    ):
        tomato = compiled.scene.tomatoes[target]
        self.target, self.center = target, tomato.center if center is None else center
        self.robot, self.start = compiled.robot, compiled.robot.start if start is None else start
        self._radius, self._threshold, self._approach = tomato.radius, threshold, approach
        self._chain = tool_chain(compiled.model, compiled.tip_site)
        self._local = start is not None
        self._rng = np.random.default_rng(seed)
        self._batches: list[GoalBatch] = []

    def __getitem__(self, k: int) -> GoalBatch:
        """Return batch ``k``."""
        while len(self._batches) <= k:
            self._batches.append(self._sample())
        return self._batches[k]

    def _sample(self) -> GoalBatch:
        arm, start = self.robot, self.start
        if self._local:
            lower, upper = np.maximum(arm.lower, start - np.pi), np.minimum(arm.upper, start + np.pi)
            guesses = self._rng.uniform(lower, upper, (LOCAL_BATCH_SIZE, len(start)))
            arm.keep_tool_roll(guesses, start)
        else:
            guesses = self._rng.uniform(arm.lower, arm.upper, (BATCH_SIZE, len(start)))
        found, tried = inverse_kinematics(
            self._chain, guesses, self.center, self._radius, arm, self._approach, self._threshold
        )
        return GoalBatch(tried, found)


def goal_configurations(
    scene: Scene,
    target: int,
    robot: str | Robot = "ur5e",
    count: int = 60,
    threshold: float = 0.65,
    min_difference: float = 0.01,
    seed: int = 0,
    approach: Approach | None = None,
    unknown: str | float = "free",
    leaves: Leaves = LEAVES[0],
) -> Goals:
    """Find collision-free configurations that bring the grasp point to a tomato's center; only the cup may touch it.

    The grasp point lies one target radius ahead of the tip along the tool axis, so the cup sits on the skin.

    Args:
        scene: The scene.
        target: Index of the tomato in the scene.
        robot: Name or file of the arm, or a `Robot`.
        count: Number of configurations to find; the search also ends after `SAMPLE_BUDGET` random configurations.
        threshold: Distance of the random grasp point from the target up to which inverse kinematics is tried, metres.
        min_difference: A configuration is new if it differs from every accepted one by at least this in some joint,
            radians.
        seed: Same seed, same result.
        approach: Directions the tool may come from; any when left out.
        unknown: "free", or "forbid" configurations with a part of the arm in space that the scan did not observe;
            "avoid" accepts those only if there are no others. The space that the arm occupies at its own start counts
            as observed.
        leaves: "rigid", "brush" for configurations that may touch leaves, or indices (k,) of the leaves to touch.

    Raises:
        InvalidValueError: No such tomato, or a number out of range.
    """
    arm = get_robot(robot)
    for depth in depths_of(unknown):
        compiled = guarded(scene, arm, arm.start, depth)
        checker = checker_of(compiled, target, leaves=leaves)
        budget = sample_budget(depth)
        found = search_goals(compiled, checker, target, count, threshold, min_difference, seed, approach, budget)
        if len(found.configurations):
            break
    return found


def sample_budget(depth: float) -> int:
    """Return the number of random configurations to try if the arm may go this deep into unknown space, metres."""
    return SAMPLE_BUDGET if math.isinf(depth) else CAREFUL_BUDGET


def search_goals(
    compiled: CompiledScene,
    checker: ProvingChecker,
    target: int,
    count: int = 60,
    threshold: float = 0.65,
    min_difference: float = 0.01,
    seed: int = 0,
    approach: Approach | None = None,
    budget: int = SAMPLE_BUDGET,
) -> Goals:
    """Search as `goal_configurations` does, in a compiled scene with a given checker.

    The search ends after ``budget`` random configurations. ``checker`` confirms what kernels find free.
    """
    check_whole("count", count, 1, budget)
    if not (is_number(threshold) and threshold > 0 and is_number(min_difference) and min_difference >= 0):
        raise InvalidValueError(
            f"expected threshold > 0 and min_difference >= 0, got {threshold!r} and {min_difference!r}"
        )
    sampler = GoalSampler(compiled, target, threshold=threshold, approach=approach, seed=require_seed(seed))
    accepted = np.empty((count, len(compiled.robot.joints)))
    found = samples = within = converged = duplicate = colliding = 0
    while found < count and samples < budget:
        batch = sampler[samples // BATCH_SIZE]
        samples += BATCH_SIZE
        within += batch.within_threshold
        converged += len(batch.configurations)
        free = batch.configurations[checker.search.are_free(batch.configurations)]
        colliding += len(batch.configurations) - len(free)
        for configuration in free:
            if (np.abs(accepted[:found] - configuration) < min_difference).all(-1).any():
                duplicate += 1
            elif not checker.is_free(configuration):
                colliding += 1
            else:
                accepted[found] = configuration
                found += 1
                if found == count:
                    break
    return Goals(accepted[:found].copy(), GoalStatistics(samples, within, converged, duplicate, colliding))


def nearest_free_goals(
    checker: CollisionChecker, sampler: GoalSampler, min_goals: int = MIN_GOALS, batches: int = BATCHES
) -> Array:
    """Return up to `MAX_GOALS` collision-free goals (k, joints), those nearest to the sampler's start first, radians.

    Args:
        checker: Checks for collisions.
        sampler: Samples goals near a start.
        min_goals: Sampling stops once there are this many free goals,
        batches: or after this many batches with at least one, or after `MAX_BATCHES`.
    """
    free: list[npt.NDArray[np.float64]] = []
    for k in range(MAX_BATCHES):
        goals = sampler[k].configurations
        free += list(goals[checker.are_free(goals)])
        if len(free) >= min_goals or (free and k + 1 >= batches) or not len(goals):
            break
    found = np.array(free).reshape(-1, len(sampler.start))
    return found[((found - sampler.start) ** 2).sum(axis=-1).argsort(kind="stable")[:MAX_GOALS]]
