"""Certificates for the tomatoes of scenes: how hard each is to reach, with a path as proof.

The rule counts collision checks, so it does not depend on the machine. Paths begin at `Robot.rating_start`:

- easy: a straight joint motion to one of the goal configurations is free.
- medium: RRTConnect needs at most `HARD` checks, in the median over `SEEDS` runs.
- hard: it needs more, or most runs find nothing within `MAX_CHECKS`; if none does, one of `SEEDS` further runs finds a
  path within `LAST_CHECKS`.
- unreachable: `SAMPLES` random configurations lead to no goal configuration, or no run finds a path. This is no proof.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.clearance import path_clearance
from greenhouse_gym.motion.collision import LEAVES, PROOF, CollisionChecker
from greenhouse_gym.motion.goals import search_goals
from greenhouse_gym.motion.proof import ProvingChecker, checker_of
from greenhouse_gym.motion.unknown_space import depths_of, guarded, unknown_lengths
from greenhouse_gym.planning.own_planners import PlannerFailedError
from greenhouse_gym.planning.planner_run import plan_with
from greenhouse_gym.planning.result import PlanResult
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene, Target
from greenhouse_gym.scene.mjcf import CompiledScene
from greenhouse_gym.scene.scene import Difficulty

GOALS, SAMPLES = 30, 10_000
"""Goal configurations to find, and random configurations after which the search for them ends."""

HARD = 5_000
"""Largest median number of collision checks over the RRTConnect runs at a medium target."""

MAX_CHECKS = 30_000
"""Collision checks after which a run fails."""

LAST_CHECKS = 100_000
"""Collision checks of the last runs, made only for targets that no other run has reached."""

SEEDS = 3
"""Runs per target; those that cannot change the rating are left out."""

_ATTEMPTS = 3  # at a search whose planning process dies
_DECIMALS = 6  # to which a witness is rounded, radians


def certify_targets(
    scene: Scene,
    robot: str | Robot = "ur5e",
    seed: int = 0,
    unknown: str | float = "free",
    max_targets: int | None = None,
    min_radius: float = 0.0,
) -> tuple[Target, ...]:
    """Rate the tomatoes of a scene as targets, by the rule of this module.

    The witness of an easy target is the shortest of the free straight motions; otherwise it is the shortest path found.
    It is rounded, and proven free after rounding.

    Args:
        scene: The scene; its present targets are ignored.
        robot: Name or file of the arm, or a `Robot`.
        seed: Same seed, same result.
        unknown: How witnesses may use space that the scan did not see, as in `plan`. A tomato is rated at the first
            depth at which it can be reached.
        max_targets: Number of tomatoes to rate, spread evenly over their distances from the shoulder; None for all.
        min_radius: Radius below which tomatoes are not rated unless all are smaller, metres.

    Returns:
        A target for each rated tomato, in their order. If the scene has an occupancy grid, each target with a witness
        holds the fraction of the witness that leads through unknown space.

    Raises:
        PlannerFailedError: The planner crashed or hung, so nothing is known about a target.
    """
    arm, targets = get_robot(robot), dict[int, Target]()
    chosen = _spread(scene, max_targets, min_radius)
    for depth in depths_of(unknown):
        compiled = guarded(scene, arm, arm.rating_start, depth)
        for tomato in chosen:
            if tomato not in targets or targets[tomato].witness is None:
                targets[tomato] = certify_target(compiled, tomato, seed)
    return _with_unknown_fractions(scene, arm, [targets[tomato] for tomato in chosen])


def certify_target(compiled: CompiledScene, tomato: int, seed: int = 0, leaves: str = LEAVES[0]) -> Target:
    """Rate one tomato as `certify_targets` does, without the fraction in unknown space.

    With ``leaves="brush"``, the arm passes through leaves as if there were none.
    """
    checker = checker_of(compiled, tomato, leaves=leaves)
    goals = search_goals(compiled, checker, tomato, GOALS, seed=seed, budget=SAMPLES).configurations
    rating = _straight(checker, compiled.robot, goals) or _planned(checker, compiled, tomato, goals, seed)
    target = Target(tomato=tomato, difficulty=rating.difficulty, robot=compiled.robot.name, goals=len(goals))
    if rating.path is None:
        return target
    return target.model_copy(
        update={
            "witness": tuple(tuple(configuration) for configuration in rating.path.tolist()),
            "checks": rating.checks,
            "clearance": round(path_clearance(compiled, tomato, rating.path, leaves), 4),
        }
    )


@dataclass(frozen=True, eq=False)
class _Rating:
    """A difficulty with its path and the checks RRTConnect needed for it; None without one."""

    difficulty: Difficulty
    path: Array | None = None
    checks: int | None = None


def _straight(checker: ProvingChecker, robot: Robot, goals: Array) -> _Rating | None:
    """Rate by the shortest free straight motion to a goal; None without one."""
    start, search = robot.rating_start, checker.search
    for goal in sorted(goals, key=lambda end: float(np.linalg.norm(end - start))):
        if search.motion_is_free(start, goal, PROOF):
            path = _rounded(robot, np.stack([start, goal]))
            if checker.path_is_free(path, PROOF):
                return _Rating("easy", path)
    return None


def _planned(checker: ProvingChecker, compiled: CompiledScene, tomato: int, goals: Array, seed: int) -> _Rating:
    """Rate by runs of RRTConnect."""
    if not len(goals):
        return _Rating("unreachable")
    results: list[PlanResult] = []
    while len(results) < SEEDS and not _decided(results):
        results.append(_search(checker, compiled, tomato, goals, seed + len(results), MAX_CHECKS))
    path = shortest_free(checker, compiled.robot, results)
    if path is not None:
        needed = sorted(map(_needed, results))[len(results) // 2]
        return _Rating("hard" if needed > HARD else "medium", path, None if math.isinf(needed) else int(needed))
    for run in range(SEEDS):
        last = _search(checker, compiled, tomato, goals, seed + run, LAST_CHECKS)
        path = shortest_free(checker, compiled.robot, [last])
        if path is not None:
            return _Rating("hard", path)
    return _Rating("unreachable")


def shortest_free(checker: CollisionChecker, robot: Robot, results: Sequence[PlanResult]) -> Array | None:
    """Return the shortest path that is still free after rounding, or None."""
    for result in sorted(results, key=lambda r: r.length if r.path is not None else math.inf):
        if result.path is not None:
            path = _rounded(robot, result.path)
            if checker.path_is_free(path, PROOF):
                return path
    return None


def _search(
    checker: ProvingChecker, compiled: CompiledScene, tomato: int, goals: Array, seed: int, checks: int
) -> PlanResult:
    """Run RRTConnect once, limited only by the number of checks.

    Up to `MAX_CHECKS`, which rate a target, it takes up the goals one by one, so that ratings stay comparable.
    """
    for _ in range(_ATTEMPTS):
        start = compiled.robot.rating_start
        result = plan_with(
            compiled, checker, goals, "RRTConnect", None, checks, seed, start, gradual_goals=checks <= MAX_CHECKS
        )
        if result.status not in ("crashed", "timeout"):
            return result
    raise PlannerFailedError(f"{compiled.scene.name}, tomato {tomato}: it cannot be rated. {result.message}")


def _needed(result: PlanResult) -> float:
    return result.checks if result.status == "solved" else math.inf


def _decided(results: Sequence[PlanResult]) -> bool:
    """Return whether more than half of all runs agree, so that the others cannot change the rating."""
    hard = sum(_needed(result) > HARD for result in results)
    solved = any(result.path is not None for result in results)
    return solved and max(hard, len(results) - hard) > SEEDS // 2


def _rounded(robot: Robot, path: Array) -> Array:
    return np.clip(path.round(_DECIMALS), robot.lower, robot.upper)


def _with_unknown_fractions(scene: Scene, robot: Robot, targets: Sequence[Target]) -> tuple[Target, ...]:
    """Return the targets with the fraction of their witness in unknown space, if the scene has an occupancy grid."""
    paths = {target.tomato: np.array(target.witness) for target in targets if target.witness is not None}
    if scene.occupancy is None or not paths:
        return tuple(targets)
    lengths = dict(zip(paths, unknown_lengths(scene, robot, list(paths.values())), strict=True))
    fractions = {tomato: round(unknown / max(length, 1e-9), 3) for tomato, (unknown, length) in lengths.items()}
    return tuple(target.model_copy(update={"unknown": fractions.get(target.tomato)}) for target in targets)


def shoulder_distances(scene: Scene) -> Array:
    """Return the distance (k,) of every tomato from the arm's shoulder, metres."""
    shoulder = scene.placement.position + [0.0, 0.0, scene.placement.shoulder_height]
    return np.array([np.linalg.norm(tomato.center - shoulder) for tomato in scene.tomatoes])


def _spread(scene: Scene, count: int | None, min_radius: float) -> list[int]:
    """Return the indices of tomatoes of a minimum radius, spread evenly over their distances from the shoulder."""
    large = [k for k, tomato in enumerate(scene.tomatoes) if tomato.radius >= min_radius]
    rows = np.array(large or range(len(scene.tomatoes)), dtype=np.int64)
    if count is None or len(rows) <= count:
        return rows.tolist()
    by_distance = rows[np.argsort(shoulder_distances(scene)[rows], kind="stable")]
    return sorted(by_distance[np.linspace(0, len(rows) - 1, count).round().astype(int)].tolist())
