"""Certificates for a scene's tomatoes: how hard each is to reach, with a path that proves it can be reached.

The rule, in collision checks, so that it does not depend on the machine:

- easy: a straight joint motion to one of the goal configurations is free.
- medium: RRTConnect needs no more than `HARD` checks, in the median over `SEEDS` runs.
- hard: it needs more, or most runs find nothing within `MAX_CHECKS`; where none does, one of as many further runs finds
  a path within `LAST_CHECKS`.
- unreachable: no goal configuration among `SAMPLES` random ones, or no run finds a path. That is no proof: a larger
  budget may find one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import (
    COARSE,
    PROOF,
    CollisionChecker,
    path_clearance,
    planning_model,
)
from greenhouse_gym.motion.goals import search_goals
from greenhouse_gym.motion.proof import ProvingChecker
from greenhouse_gym.motion.reach import arm_reaches
from greenhouse_gym.motion.unknown_space import depths_of, guarded, unknown_lengths
from greenhouse_gym.planning.query import plan_with
from greenhouse_gym.planning.registered import PlannerFailedError
from greenhouse_gym.planning.result import PlanResult
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene, Target
from greenhouse_gym.scene.mjcf import CompiledScene
from greenhouse_gym.scene.scene import Difficulty

GOALS, SAMPLES = 30, 10_000
"""Goal configurations looked for, and random configurations after which the search for them ends."""

HARD = 5_000
"""Collision checks RRTConnect needs at most, in the median over the runs, for a target that is medium."""

MAX_CHECKS = 30_000
"""Collision checks after which a run counts as failed."""

LAST_CHECKS = 100_000
"""Collision checks of the last runs, which only targets get that no other run has reached."""

SEEDS = 3
"""Runs per target; those that cannot change the rating any more are left out."""

_ATTEMPTS = 3  # at a search whose planning process dies
_DECIMALS = 6  # to which a witness is rounded, radians


def certify_targets(
    scene: Scene,
    robot: str | Robot = "ur5e",
    seed: int = 0,
    unknown: str | float = "free",
    most: int | None = None,
    smallest: float = 0.0,
) -> tuple[Target, ...]:
    """Rate the tomatoes of a scene as targets, by the rule of this module.

    The witness of an easy target is the shortest of the free straight motions; else it is the shortest of the paths
    found. It is rounded, and proven free after the rounding.

    Args:
        scene: The scene; targets it already has are not looked at.
        robot: Name or file of the arm, or a `Robot`.
        seed: Same seed, same result.
        unknown: What space that the scan did not see is for a witness, as `plan` takes it: a tomato is rated by the
            first depth at which it can be reached.
        most: How many to rate, spread evenly over their distances from the shoulder; None for all.
        smallest: Radius below which tomatoes are not rated, unless all of them are as small, metres.

    Returns:
        A target for each of these tomatoes, in their order. Where the scene says what was seen, they tell the share of
        their witness's way through unknown space.

    Raises:
        PlannerFailedError: The planner died or hung, which says nothing about a target.
    """
    arm, targets = get_robot(robot), dict[int, Target]()
    chosen = _spread(scene, most, smallest)
    for depth in depths_of(unknown):
        compiled = guarded(scene, arm, arm.start, depth)
        for tomato in chosen:
            if tomato not in targets or targets[tomato].witness is None:
                targets[tomato] = certify_target(compiled, tomato, seed)
    return _with_unknown_fractions(scene, arm, [targets[tomato] for tomato in chosen])


def _spread(scene: Scene, most: int | None, smallest: float) -> list[int]:
    """Tomatoes to rate, so many at most, near ones and far ones, none smaller than it must be."""
    large = [k for k, tomato in enumerate(scene.tomatoes) if tomato.radius >= smallest]
    rows = np.array(large or range(len(scene.tomatoes)), dtype=np.int64)
    if most is None or len(rows) <= most:
        return rows.tolist()
    shoulder = scene.placement.position + [0.0, 0.0, scene.placement.shoulder_height]
    distances = [np.linalg.norm(scene.tomatoes[k].center - shoulder) for k in rows]
    by_distance = rows[np.argsort(distances, kind="stable")]
    return sorted(by_distance[np.linspace(0, len(rows) - 1, most).round().astype(int)].tolist())


def certify_target(compiled: CompiledScene, tomato: int, seed: int = 0) -> Target:
    """Rate one tomato; see `certify_targets`. The share through unknown space is left out."""
    checker = ProvingChecker(planning_model(compiled, tomato), arm_reaches(compiled.robot))
    goals = search_goals(compiled, checker, tomato, GOALS, seed=seed, budget=SAMPLES).configurations
    found = _straight(checker, compiled.robot, goals) or _planned(checker, compiled, tomato, goals, seed)
    target = Target(tomato=tomato, difficulty=found.difficulty, robot=compiled.robot.name, goals=len(goals))
    if found.path is None:
        return target
    return target.model_copy(
        update={
            "witness": tuple(tuple(configuration) for configuration in found.path.tolist()),
            "checks": found.checks,
            "clearance": round(path_clearance(compiled, tomato, found.path), 4),
        }
    )


@dataclass(frozen=True, eq=False)
class _Found:
    """A rating with its path, None where none was found, and the checks RRTConnect needed for one."""

    difficulty: Difficulty
    path: Array | None = None
    checks: int | None = None


def _straight(checker: CollisionChecker, robot: Robot, goals: Array) -> _Found | None:
    """The shortest free straight motion to a goal, if there is one."""
    for goal in sorted(goals, key=lambda end: float(np.linalg.norm(end - robot.start))):
        if checker.motion_is_free(robot.start, goal, COARSE):
            path = _rounded(robot, np.stack([robot.start, goal]))
            if checker.path_is_free(path, PROOF):
                return _Found("easy", path)
    return None


def _planned(checker: CollisionChecker, compiled: CompiledScene, tomato: int, goals: Array, seed: int) -> _Found:
    """What RRTConnect makes of a target."""
    if not len(goals):
        return _Found("unreachable")
    results: list[PlanResult] = []
    while len(results) < SEEDS and not _decided(results):
        results.append(_searched(checker, compiled, tomato, goals, seed + len(results), MAX_CHECKS))
    path = _shortest(checker, compiled.robot, results)
    if path is not None:
        needed = sorted(map(_needed, results))[len(results) // 2]
        return _Found("hard" if needed > HARD else "medium", path, None if math.isinf(needed) else int(needed))
    for run in range(SEEDS):
        last = _searched(checker, compiled, tomato, goals, seed + run, LAST_CHECKS)
        path = _shortest(checker, compiled.robot, [last])
        if path is not None:
            return _Found("hard", path)
    return _Found("unreachable")


def _shortest(checker: CollisionChecker, robot: Robot, results: Sequence[PlanResult]) -> Array | None:
    """The shortest of the paths found that is free after its rounding too, None where there is none."""
    for result in sorted(results, key=lambda r: r.length if r.path is not None else math.inf):
        if result.path is not None:
            path = _rounded(robot, result.path)
            if checker.path_is_free(path, PROOF):
                return path
    return None


def _searched(
    checker: CollisionChecker, compiled: CompiledScene, tomato: int, goals: Array, seed: int, checks: int
) -> PlanResult:
    """One run of RRTConnect, which the checks end and not the machine."""
    for _ in range(_ATTEMPTS):
        result = plan_with(compiled, checker, tomato, "RRTConnect", None, checks, goals, seed)
        if result.status not in ("crashed", "timeout"):
            return result
    raise PlannerFailedError(f"{compiled.scene.name}, tomato {tomato}: it cannot be rated. {result.message}")


def _needed(result: PlanResult) -> float:
    return result.checks if result.status == "solved" else math.inf


def _decided(results: Sequence[PlanResult]) -> bool:
    """Whether more than half of all runs agree, so that the others cannot change the rating."""
    much = sum(_needed(result) > HARD for result in results)
    solved = any(result.path is not None for result in results)
    return solved and max(much, len(results) - much) > SEEDS // 2


def _rounded(robot: Robot, path: Array) -> Array:
    return np.clip(path.round(_DECIMALS), robot.lower, robot.upper)


def _with_unknown_fractions(scene: Scene, robot: Robot, targets: Sequence[Target]) -> tuple[Target, ...]:
    """The targets with the share of their witness's way through unknown space, where the scene says what was seen."""
    paths = {target.tomato: np.array(target.witness) for target in targets if target.witness is not None}
    if scene.occupancy is None or not paths:
        return tuple(targets)
    ways = dict(zip(paths, unknown_lengths(scene, robot, list(paths.values())), strict=True))
    shares = {tomato: round(unknown / max(way, 1e-9), 3) for tomato, (unknown, way) in ways.items()}
    return tuple(target.model_copy(update={"unknown": shares.get(target.tomato)}) for target in targets)
