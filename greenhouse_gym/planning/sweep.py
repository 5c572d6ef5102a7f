"""Planners over many targets and seeds, with budgets in collision checks: resumable, and spread over workers.

What ends a run is the number of its checks, and what leaves a planner out of further seeds is the sum of them, so a
machine with other work on it, or an executor, gives the same runs; only the seconds differ.
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
"""What was asked of a planner and what came of it, as a line of ``runs.jsonl``."""

_KEYS = ("planner", "scene", "scene_hash", "target", "seed", "max_checks", "time_limit", "first_solution")
_STEPS = 20  # about as many steps of the cost's improvement are noted


@dataclass(frozen=True)
class SweepSettings:
    """How planners are run.

    Attributes:
        seeds: Runs per target.
        max_checks: Collision checks per plan.
        time_limit: Seconds per plan, at most.
        first_solution: Whether no planner may improve its first path.
        budget: Checks; a planner that has used as many gets no further seed.
    """

    seeds: int = 3
    max_checks: int = 50_000
    time_limit: float = 60.0
    first_solution: bool = False
    budget: float = math.inf


@dataclass(frozen=True)
class _Piece:
    """The runs at one target with one seed that are still to be made; a piece can travel."""

    scene: Scene
    target: Target
    wanted: tuple[Run, ...]


def reachable_targets(bank: SceneBank, split: str, count: int) -> list[tuple[Scene, Target]]:
    """At most ``count`` reachable targets of a split: a third of each difficulty, more where one has too few.

    They are drawn in an order that is always the same, so fewer targets are a part of more, and the difficulties take
    turns, so that an interrupted benchmark has seen some of each.
    """
    scenes = [bank.scene(name) for name in bank.names(split)]
    by_difficulty = [
        [(scene, t) for scene in scenes for t in scene.targets if t.difficulty == difficulty]
        for difficulty in DIFFICULTIES
        if difficulty != "unreachable"
    ]
    rng = np.random.default_rng(0)
    chosen: list[list[tuple[Scene, Target]]] = []
    for rest, group in enumerate(sorted(by_difficulty, key=len)):
        share = min(len(group), (count - sum(map(len, chosen))) // (len(by_difficulty) - rest))
        chosen.append([group[i] for i in rng.permutation(len(group))[:share]])
    return [item for turn in zip_longest(*chosen) for item in turn if item is not None]


def sweep_planners(
    planners: Sequence[str],
    targets: Sequence[tuple[Scene, Target]],
    settings: SweepSettings,
    file: Path,
    executor: Executor | None = None,
    on_piece: Callable[[str, int, int], None] | None = None,
) -> list[Run]:
    """Run planners at targets; what is in the file already is not run again.

    Args:
        planners: Their names.
        targets: Scenes with targets.
        settings: How they are run.
        file: Lines of JSON, one for each run, to which this process adds the runs at a target as soon as they are made.
        executor: Where they are run, those at one target with one seed together; None runs them here.
        on_piece: Told the seed's name, how many targets are done with it, and of how many.

    Returns:
        All runs that are asked for, seed by seed, target by target; but for seconds the same with any executor.
    """
    lines = file.read_text().splitlines() if file.exists() else []
    done = {_key(run): run for run in map(json.loads, lines)}
    # a bank built anew has new scenes under old names
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
            pieces = [
                _Piece(scene, target, missing)
                for (scene, target), wanted in zip(targets, asked, strict=True)
                if (missing := tuple(run for run in wanted if _key(run) not in done))
            ]
            for count, made in enumerate(completed(_made, pieces, executor), 1):
                for run in made:
                    done[_key(run)] = run
                    out.write(json.dumps(run) + "\n")
                out.flush()
                if on_piece:
                    on_piece(f"planning, seed {seed}", count, len(pieces))
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


def _made(piece: _Piece) -> list[Run]:
    """The runs of a piece, all with the same goals."""
    began = time.perf_counter()
    goals = goal_configurations(piece.scene, piece.target.tomato)
    spent = round(time.perf_counter() - began, 4)
    return [
        {**wanted, "difficulty": piece.target.difficulty, **measure(piece.scene, wanted, goals, spent)}
        for wanted in piece.wanted
    ]


def measure(scene: Scene, wanted: Run, goals: Goals, goal_seconds: float) -> Run:
    """Run a planner once, and note what came of it."""
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
        "costs": result.costs[:: math.ceil(len(result.costs) / _STEPS) or 1].round(4).tolist(),
        "message": result.message[:120],
    }


def smoothness(path: Array) -> float:
    """OMPL's measure of a path (k, n), ``PathGeometric::smoothness``: 0 is straight."""
    steps = np.diff(path, axis=0)
    steps = steps[np.linalg.norm(steps, axis=-1) > 0]
    lengths = np.linalg.norm(steps, axis=-1)
    cosines = np.einsum("ij,ij->i", steps[:-1], steps[1:]) / (lengths[:-1] * lengths[1:])
    turns = np.arccos(np.clip(cosines, -1.0, 1.0))
    return float(((2 * turns / (lengths[:-1] + lengths[1:])) ** 2).sum())


def bare_rate(scene: Scene, target: int, checks: int = 400) -> float:
    """Checks per second of MuJoCo alone, over random configurations; measured beside every run."""
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
