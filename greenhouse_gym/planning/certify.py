"""Certificates for the tomatoes of scenes and banks: how hard each is to reach, with a path as proof.

The rule counts collision checks, so it does not depend on the machine. Paths begin at `Robot.rating_start`:

- easy: a straight joint motion to one of the goal configurations is free.
- medium: RRTConnect needs at most `HARD` checks, in the median over `SEEDS` runs.
- hard: it needs more, or most runs find nothing within `MAX_CHECKS`; if none does, one of `SEEDS` further runs finds a
  path within `LAST_CHECKS`.
- unreachable: `SAMPLES` random configurations lead to no goal configuration, or no run finds a path. This is no proof.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.common.files import resolved
from greenhouse_gym.errors import FileFormatError, InvalidValueError, require_seed
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.clearance import path_clearance
from greenhouse_gym.motion.collision import LEAVES, PROOF, CollisionChecker, planning_model
from greenhouse_gym.motion.goals import search_goals
from greenhouse_gym.motion.proof import ProvingChecker, checker_of
from greenhouse_gym.motion.unknown_space import depths_of, guarded, unknown_lengths
from greenhouse_gym.planning.own_planners import PlannerFailedError
from greenhouse_gym.planning.query import plan_with
from greenhouse_gym.planning.result import PlanResult
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene, SceneBank, Target
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene
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

RATING = "rating"
"""Key in the provenance settings of a rated scene: the arm's name and checksum, the seed and the scene's checksum."""

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


def new_folder(bank: str | Path | SceneBank, out: str | Path) -> Path:
    """Return the folder of a bank that is made from another one.

    Raises:
        InvalidValueError: It is the folder of that bank.
    """
    folder = resolved(out)
    if folder == SceneBank.open(bank).path.resolve():
        raise InvalidValueError(f"{folder}: the new bank needs another folder than the bank it is made from")
    return folder


def rate_bank(
    bank: str | Path | SceneBank,
    robot: str | Path | Robot,
    out: str | Path,
    seed: int = 0,
    per_scene: int | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> SceneBank:
    """Rate the tomatoes of a bank for an arm and write a new bank with these targets.

    Targets for other arms are kept. Each scene is written when it is finished and the manifest last, so an interrupted
    run resumes; scenes rated for another arm, from another scene or with another seed are rated again.

    Args:
        bank: The bank.
        robot: Name or file of the arm, or a `Robot`.
        out: Folder of the new bank; not that of the old one.
        seed: Same seed, same ratings.
        per_scene: Number of tomatoes to rate in each scene, those nearest to the arm's shoulder; None for all.
        on_progress: Called with the number of rated tomatoes, including those of scenes finished earlier.

    Raises:
        InvalidValueError: ``out`` is the bank's own folder, or the arm's start is in collision in every scene.
    """
    opened, arm, folder = SceneBank.open(bank), get_robot(robot), new_folder(bank, out)
    if per_scene is not None and per_scene < 1:
        raise InvalidValueError(f"per_scene must be at least 1 or None, got {per_scene!r}")
    checksum = sha256(arm.path.read_bytes()).hexdigest()
    rating = {"robot": arm.name, "file_sha256": checksum, "seed": require_seed(seed), "per_scene": per_scene}
    rated: list[tuple[Scene, str]] = []
    blocked: list[str] = []
    done = 0
    for name in opened.names():
        scene = opened.scene(name)
        source = {**rating, "scene_sha256": sha256(scene.model_dump_json().encode()).hexdigest()}
        result = load_rated(folder / f"{name}.json", source)
        if result is None:
            compiled = compile_scene(scene, arm)
            contacts = _start_contacts(compiled)
            if contacts:
                blocked.append(f"{name} ({contacts})")
            targets: list[Target] = []
            for tomato in _nearest(scene, per_scene):
                targets.append(certify_target(compiled, tomato, seed))
                if on_progress is not None:
                    on_progress(done + len(targets))
            result = _with_targets(scene, targets, source)
            result.save(folder / f"{name}.json")
        done += len(_nearest(scene, per_scene))
        rated.append((result, opened.split_of(name)))
    if blocked and len(blocked) == len(rated):
        raise InvalidValueError(f"{arm.name} touches something at its start in every scene: {', '.join(blocked)}")
    return write_bank(folder, rated, folder.name, f"{opened.manifest.name}, rated for {arm.name}")


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


def _shoulder_distances(scene: Scene) -> Array:
    """Return the distance (k,) of every tomato from the arm's shoulder, metres."""
    shoulder = scene.placement.position + [0.0, 0.0, scene.placement.shoulder_height]
    return np.array([np.linalg.norm(tomato.center - shoulder) for tomato in scene.tomatoes])


def _nearest(scene: Scene, count: int | None) -> list[int]:
    """Return the indices of the tomatoes nearest to the shoulder."""
    return sorted(np.argsort(_shoulder_distances(scene), kind="stable")[:count].tolist())


def _spread(scene: Scene, count: int | None, min_radius: float) -> list[int]:
    """Return the indices of tomatoes of a minimum radius, spread evenly over their distances from the shoulder."""
    large = [k for k, tomato in enumerate(scene.tomatoes) if tomato.radius >= min_radius]
    rows = np.array(large or range(len(scene.tomatoes)), dtype=np.int64)
    if count is None or len(rows) <= count:
        return rows.tolist()
    by_distance = rows[np.argsort(_shoulder_distances(scene)[rows], kind="stable")]
    return sorted(by_distance[np.linspace(0, len(rows) - 1, count).round().astype(int)].tolist())


def load_rated(path: Path, source: dict[str, Any], key: str = RATING) -> Scene | None:
    """Load a scene if it exists and was rated from this source; ``key`` is that of the rating."""
    try:
        scene = Scene.load(path)
    except FileFormatError:
        return None
    return scene if scene.provenance.settings.get(key) == source else None


def _with_targets(scene: Scene, targets: list[Target], source: dict[str, Any]) -> Scene:
    others = [target for target in scene.targets if target.robot != source["robot"]]
    return with_source(scene.model_copy(update={"targets": (*others, *targets)}), source, RATING)


def with_source(scene: Scene, source: dict[str, Any], key: str) -> Scene:
    """Return a scene whose provenance holds the source of a rating, or of the scene itself, under a key."""
    settings = {**scene.provenance.settings, key: source}
    return scene.model_copy(update={"provenance": scene.provenance.model_copy(update={"settings": settings})})


def _start_contacts(compiled: CompiledScene) -> str:
    """Return a contact of the arm at its start, or an empty text; a scene without tomatoes is not checked."""
    if not compiled.scene.tomatoes:
        return ""
    contacts = CollisionChecker(planning_model(compiled, 0)).contacts(compiled.robot.rating_start)
    return ", ".join(f"{compiled.geom_name(a)} with {compiled.geom_name(b)}" for a, b in contacts[:1])
