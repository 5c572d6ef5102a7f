"""Certificates for a scene's tomatoes: how hard each is to reach, with a path that proves it can be reached."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.planning.collision import PROOF, CollisionChecker, planning_model
from greenhouse_gym.planning.goals import search_goals
from greenhouse_gym.planning.query import PlanResult, plan_with
from greenhouse_gym.planning.unseen import depths_of, guarded
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import DIFFICULTIES, Scene, Target
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene
from greenhouse_gym.scene.scene import Difficulty

EASY, MEDIUM = 500, 5_000
"""Collision checks RRTConnect needs, in the median over `SEEDS` runs, for a target that is easy or medium at most."""

MAX_CHECKS = 50_000
"""Collision checks after which a run counts as failed."""

SEEDS = 3
"""Runs per target."""

_TIME_LIMIT = 60.0  # seconds; far more than the checks take, so that they and not the machine decide
_DECIMALS = 6  # of a witness, radians


def certify_targets(
    scene: Scene, robot: str | Robot = "ur5e", seed: int = 0, unseen: str | float = "free"
) -> tuple[Target, ...]:
    """Rate every tomato of a scene as a target.

    "easy", "medium" and "hard" go by the collision checks that RRTConnect needs (`EASY`, `MEDIUM`). "unreachable" is a
    tomato for which no goal configuration or no path was found. The witness is the shortest of the paths found,
    rounded, and proven free after the rounding. Runs that cannot change the rating any more are left out.

    Args:
        scene: The scene; targets it already has are not looked at.
        robot: Name or file of the arm, or a `Robot`.
        seed: Same seed, same result.
        unseen: What space that the scan did not see is for a witness, as `plan` takes it: a tomato is rated by the
            first depth at which it can be reached.

    Returns:
        A target for each tomato, in their order.
    """
    arm, targets = get_robot(robot), dict[int, Target]()
    for depth in depths_of(unseen):
        compiled = compile_scene(guarded(scene, arm, arm.start, depth), arm)
        for tomato in range(len(scene.tomatoes)):
            if tomato not in targets or targets[tomato].witness is None:
                targets[tomato] = certify_target(compiled, tomato, seed)
    return tuple(targets[tomato] for tomato in range(len(scene.tomatoes)))


def certify_target(compiled: CompiledScene, tomato: int, seed: int = 0) -> Target:
    """Rate one tomato; see `certify_targets`."""
    checker = CollisionChecker(planning_model(compiled, tomato))
    goals = search_goals(compiled, checker, tomato, seed=seed)
    results: list[PlanResult] = []
    ratings: list[Difficulty] = []
    while len(goals.configurations) and len(results) < SEEDS and not _decided(ratings):
        seed_of_run = seed + len(results)
        results.append(plan_with(compiled, checker, tomato, "RRTConnect", _TIME_LIMIT, MAX_CHECKS, goals, seed_of_run))
        ratings.append(_rating(results[-1]))
    witness = _witness(checker, compiled.robot, results)
    if witness is None:
        return Target(tomato=tomato, difficulty="unreachable", robot=compiled.robot.name)
    difficulty = sorted(ratings, key=DIFFICULTIES.index)[len(ratings) // 2]
    return Target(
        tomato=tomato,
        difficulty=difficulty,
        robot=compiled.robot.name,
        witness=tuple(tuple(configuration) for configuration in witness.tolist()),
    )


def _rating(result: PlanResult) -> Difficulty:
    needed = result.checks if result.status == "solved" else math.inf
    return "easy" if needed <= EASY else "medium" if needed <= MEDIUM else "hard"


def _decided(ratings: Sequence[Difficulty]) -> bool:
    """Whether more than half of all runs agree, so that the others cannot change the median."""
    return any(ratings.count(rating) > SEEDS // 2 for rating in ratings)


def _witness(checker: CollisionChecker, robot: Robot, results: Sequence[PlanResult]) -> Array | None:
    for result in sorted(results, key=lambda r: r.length if r.path is not None else math.inf):
        if result.path is not None:
            rounded = np.clip(result.path.round(_DECIMALS), robot.lower, robot.upper)
            if checker.path_is_free(rounded, PROOF):
                return rounded
    return None
