"""Goal configurations: arm configurations with the grasp point on the target's center and nothing touched.

Method: the randomized forward kinematics search of "Simulation of a robotics operation" in the paper this package
follows, random configurations with the grasp point within a threshold of the target, brought onto it by inverse
kinematics (damped least squares; Wampler 1986), without near-duplicates. Everything runs on batches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from greenhouse_gym.errors import InvalidValueError, require_seed
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import CollisionChecker, checker_of
from greenhouse_gym.motion.inverse_kinematics import Approach, inverse_kinematics
from greenhouse_gym.motion.unknown_space import depths_of, guarded
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.robots.kinematics import tool_chain, tool_state
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import CompiledScene

SAMPLE_BUDGET = 40_000
"""After so many random configurations the search gives up."""

CAREFUL_BUDGET = 5_000
"""The same where the arm keeps out of unknown space: for many tomatoes nothing is found, however long the search."""

_BATCH = 1000


@dataclass(frozen=True)
class GoalStatistics:
    """What became of the random configurations of a goal search.

    Attributes:
        samples: Random configurations drawn.
        within_threshold: Those with the grasp point within the threshold of the target.
        converged: Those that inverse kinematics brought onto the target within the joint limits, and into the approach
            cone where there is one.
        duplicate: Converged ones that repeat an accepted one.
        colliding: Converged, new ones that touch something.
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
        configurations: (k, joints) radians, in the order found; k = 0 where none exists.
        statistics: How the search went.
    """

    configurations: Array
    statistics: GoalStatistics


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
) -> Goals:
    """Find configurations that bring the grasp point to a tomato's center without touching anything but by the cup.

    The grasp point lies one target radius ahead of the tip along the tool axis, so the cup sits on the skin.

    Args:
        scene: The scene.
        target: Index of the tomato in the scene.
        robot: Name or file of the arm, or a `Robot`.
        count: How many configurations to find; the search also ends after `SAMPLE_BUDGET` random configurations.
        threshold: Distance of the random grasp point from the target up to which inverse kinematics is tried, metres.
        min_difference: A configuration is new if it differs from every accepted one by at least this in some joint,
            radians.
        seed: Same seed, same result.
        approach: Directions the tool may come from; any when left out.
        unknown: "free", or "forbid" configurations in which some of the arm is in space that the scan did not see; with
            "avoid" those are found only where there are no others. The arm's own start counts as seen.

    Raises:
        InvalidValueError: No such tomato, or a number that makes no sense.
    """
    arm = get_robot(robot)
    for depth in depths_of(unknown):
        compiled = guarded(scene, arm, arm.start, depth)
        checker = checker_of(compiled, target)
        budget = sample_budget(depth)
        found = search_goals(compiled, checker, target, count, threshold, min_difference, seed, approach, budget)
        if len(found.configurations):
            break
    return found


def sample_budget(depth: float) -> int:
    """Random configurations after which the search ends where the arm may go so deep into unknown space, metres."""
    return SAMPLE_BUDGET if math.isinf(depth) else CAREFUL_BUDGET


def search_goals(
    compiled: CompiledScene,
    checker: CollisionChecker,
    target: int,
    count: int = 60,
    threshold: float = 0.65,
    min_difference: float = 0.01,
    seed: int = 0,
    approach: Approach | None = None,
    budget: int = SAMPLE_BUDGET,
) -> Goals:
    """As `goal_configurations`, for a scene compiled and a checker made already.

    The search ends after ``budget`` random configurations.
    """
    if count < 1:
        raise InvalidValueError(f"count must be at least 1, got {count!r}")
    if not (threshold > 0 and min_difference >= 0):
        raise InvalidValueError(
            f"expected threshold > 0 and min_difference >= 0, got {threshold!r} and {min_difference!r}"
        )
    arm, tomato = compiled.robot, compiled.scene.tomatoes[target]
    chain = tool_chain(compiled.model, compiled.tip_site)
    rng = np.random.default_rng(require_seed(seed))
    accepted = np.empty((count, len(arm.joints)))
    found = samples = within = converged = duplicate = colliding = 0
    while found < count and samples < budget:
        batch = rng.uniform(arm.lower, arm.upper, (_BATCH, len(arm.joints)))
        samples += _BATCH
        offset = tool_state(chain, batch, tomato.radius).point - tomato.center
        near = batch[(offset * offset).sum(-1) <= threshold**2]
        within += len(near)
        solutions = inverse_kinematics(chain, near, tomato.center, tomato.radius, arm, approach)
        converged += len(solutions)
        for solution in solutions:
            if (np.abs(accepted[:found] - solution) < min_difference).all(-1).any():
                duplicate += 1
            elif not checker.is_free(solution):
                colliding += 1
            else:
                accepted[found] = solution
                found += 1
                if found == count:
                    break
    return Goals(accepted[:found].copy(), GoalStatistics(samples, within, converged, duplicate, colliding))
