"""Runs of planners over many targets and seeds, with budgets in collision checks: resumable and parallel.

The number of its checks ends a run, and their sum excludes a planner from further seeds. So a busy machine or an
executor gives the same runs; only the seconds differ.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from hashlib import sha256
from itertools import zip_longest
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from greenhouse_gym.common.executors import completed
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import planning_model
from greenhouse_gym.motion.goals import Goals, goal_configurations
from greenhouse_gym.planning.query import plan
from greenhouse_gym.scene import DIFFICULTIES, Scene, SceneBank, Target
from greenhouse_gym.scene.mjcf import compile_scene

Run = dict[str, Any]
"""A run's settings and results, as a line of ``runs.jsonl``."""

_KEYS = ("planner", "scene", "scene_hash", "target", "seed", "max_checks", "time_limit", "first_solution")
_MAX_COSTS = 20  # about as many improvements of the cost are stored


@dataclass(frozen=True)
class SweepSettings:
    """Settings of the runs.

    Attributes:
        seeds: Runs per target.
        max_checks: Collision checks per plan.
        time_limit: Largest number of seconds per plan.
        first_solution: True if no planner may improve its first path.
        budget: Collision checks after which a planner gets no further seed.
    """

    seeds: int = 3
    max_checks: int = 50_000
    time_limit: float = 60.0
    first_solution: bool = False
    budget: float = math.inf


@dataclass(frozen=True)
class _Batch:
    """The missing runs at one target with one seed; it can be pickled."""

    scene: Scene
    target: Target
    wanted: tuple[Run, ...]


def reachable_targets(bank: SceneBank, split: str, count: int) -> list[tuple[Scene, Target]]:
    """Sample reachable targets of a split, a third of each difficulty, more where a difficulty has too few.

    The order is fixed, so fewer targets are a subset of more, and alternates between the difficulties, so that an
    interrupted benchmark has covered all of them.

    Args:
        bank: The bank.
        split: Name of the split.
        count: Largest number of targets.
    """
    scenes = [bank.scene(name) for name in bank.names(split)]
    by_difficulty = [
        [(scene, t) for scene in scenes for t in scene.targets if t.difficulty == difficulty]
        for difficulty in DIFFICULTIES
        if difficulty != "unreachable"
    ]
    rng = np.random.default_rng(0)
    chosen: list[list[tuple[Scene, Target]]] = []
    for k, group in enumerate(sorted(by_difficulty, key=len)):
        size = min(len(group), (count - sum(map(len, chosen))) // (len(by_difficulty) - k))
        chosen.append([group[i] for i in rng.permutation(len(group))[:size]])
    return [item for turn in zip_longest(*chosen) for item in turn if item is not None]


def sweep_planners(
    planners: Sequence[str],
    targets: Sequence[tuple[Scene, Target]],
    settings: SweepSettings,
    file: Path,
    executor: Executor | None = None,
    on_progress: Callable[[str, int, int], None] | None = None,
) -> list[Run]:
    """Run planners at targets; runs that are in the file are not repeated.

    Args:
        planners: Names of planners.
        targets: Scenes with targets.
        settings: Settings of the runs.
        file: JSON Lines file with one line per run. This process appends the runs at a target when they are finished.
        executor: Where to run them, those at one target with one seed together; None for this process.
        on_progress: Called with the seed's name, the number of targets finished with it, and their number.

    Returns:
        All runs, seed by seed and target by target; the same with any executor, except seconds.
    """
    lines = file.read_text().splitlines() if file.exists() else []
    done = {_key(run): run for run in map(json.loads, lines)}
    # a rebuilt bank may have new scenes under old names
    scenes = {scene.name: scene for scene, _ in targets}
    hashes = {name: sha256(scene.model_dump_json().encode()).hexdigest()[:8] for name, scene in scenes.items()}
    runs: list[Run] = []
    with file.open("a") as out:
        for seed in range(settings.seeds):
            used = Counter[str]()
            for run in runs:
                used[run["planner"]] += run["checks"]
            asked = [
                [_wanted(planner, scene, target, seed, hashes, settings) for planner in planners
                 if used[planner] < settings.budget]
                for scene, target in targets
            ]  # fmt: skip
            batches = [
                _Batch(scene, target, missing)
                for (scene, target), wanted in zip(targets, asked, strict=True)
                if (missing := tuple(run for run in wanted if _key(run) not in done))
            ]
            for count, results in enumerate(completed(_run_batch, batches, executor), 1):
                for run in results:
                    done[_key(run)] = run
                    out.write(json.dumps(run) + "\n")
                out.flush()
                if on_progress:
                    on_progress(f"planning, seed {seed}", count, len(batches))
            runs += [done[_key(run)] for wanted in asked for run in wanted]
    return runs


def _wanted(
    planner: str, scene: Scene, target: Target, seed: int, hashes: dict[str, str], settings: SweepSettings
) -> Run:
    return {
        "planner": planner,
        "scene": scene.name,
        "target": target.tomato,
        "seed": seed,
        "scene_hash": hashes[scene.name],
        "max_checks": settings.max_checks,
        "time_limit": settings.time_limit,
        "first_solution": settings.first_solution,
    }


def _key(run: Run) -> tuple[Any, ...]:
    return tuple(run.get(key) for key in _KEYS)


def _run_batch(batch: _Batch) -> list[Run]:
    """Make the runs of a batch, all with the same goals."""
    began = time.perf_counter()
    goals = goal_configurations(batch.scene, batch.target.tomato)
    spent = round(time.perf_counter() - began, 4)
    return [
        {**wanted, "difficulty": batch.target.difficulty, **measure(batch.scene, wanted, goals, spent)}
        for wanted in batch.wanted
    ]


def measure(scene: Scene, wanted: Run, goals: Goals, goal_seconds: float) -> Run:
    """Run a planner once and return the results."""
    result = plan(
        scene, wanted["target"], planner=wanted["planner"], time_limit=wanted["time_limit"],
        max_checks=wanted["max_checks"], goals=goals, seed=wanted["seed"], first_solution=wanted["first_solution"],
    )  # fmt: skip
    numbers = {
        field.name: value if math.isfinite(value) else None
        for field in dataclasses.fields(result)
        if isinstance(value := getattr(result, field.name), int | float)
    }
    numbers = {name: value if isinstance(value, int | None) else round(value, 6) for name, value in numbers.items()}
    return {
        "status": result.status,
        **numbers,
        "goal_search_time": goal_seconds,
        "bare_rate": round(bare_rate(scene, wanted["target"])),
        "first_solution_time": round(float(result.costs[0, 0]), 6) if result.path is not None else None,
        "raw_smoothness": None if result.raw_path is None else round(smoothness(result.raw_path), 4),
        "smoothness": None if result.path is None else round(smoothness(result.path), 4),
        "costs": result.costs[:: math.ceil(len(result.costs) / _MAX_COSTS) or 1].round(4).tolist(),
        "message": result.message[:120],
    }


def smoothness(path: Array) -> float:
    """Return OMPL's measure of a path (k, n), ``PathGeometric::smoothness``: 0 is straight."""
    steps = np.diff(path, axis=0)
    steps = steps[np.linalg.norm(steps, axis=-1) > 0]
    lengths = np.linalg.norm(steps, axis=-1)
    cosines = np.einsum("ij,ij->i", steps[:-1], steps[1:]) / (lengths[:-1] * lengths[1:])
    turns = np.arccos(np.clip(cosines, -1.0, 1.0))
    return float(((2 * turns / (lengths[:-1] + lengths[1:])) ** 2).sum())


def bare_rate(scene: Scene, target: int, checks: int = 400) -> float:
    """Measure the checks per second of bare MuJoCo at random configurations."""
    compiled = compile_scene(scene)
    model = planning_model(compiled, target)
    data = mujoco.MjData(model)
    qpos = data.qpos
    batch = np.random.default_rng(0).uniform(compiled.robot.lower, compiled.robot.upper, (checks, model.nv))
    began = time.perf_counter()
    for configuration in batch:
        qpos[:] = configuration
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
    return checks / (time.perf_counter() - began)
