"""Planners over the targets of a bank, run by run, resumable, with budgets in collision checks.

    python benchmarks/planners.py --planners all --first-solution --budget 2000000   # all planners
    python benchmarks/planners.py --planners RRTConnect SBL --seeds 3 --max-checks 20000 --out results-of-two

Each run is added to OUT/runs.jsonl at once; runs that are there already are not repeated, so an interrupted benchmark
goes on where it stopped and a further seed costs only that seed. From the runs come OUT/planners.json, planners.md,
two plots and planners.db, an SQLite file in the schema of OMPL's benchmarks, which Planner Arena opens. Times are over
all runs, failed ones included. Planners that go on improving their paths use all of their checks, unless
``--first-solution`` has them stop at the first; a run with it tells how soon, one without how good.

What ends a run is the number of its checks, and what leaves a planner out of further seeds is the sum of them, so a
machine with other work on it gives the same paths; only the seconds differ, and the rate of bare checks, measured
beside every run, says by how much. ``--time-limit`` is for planners that check too little to end by their checks
(LazyPRMstar) or that do not look at them: it decides nothing as long as it is generous.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import time
from collections import Counter
from collections.abc import Sequence
from hashlib import sha256
from itertools import zip_longest
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from planner_reports import planner_arena_database, plots, summary, table
from results_file import RESULTS, write_results
from rich.progress import track

from greenhouse_gym.geometry import Array
from greenhouse_gym.paths import write_atomically
from greenhouse_gym.planning import (
    PAPER_PLANNERS,
    PLANNERS,
    goal_configurations,
    plan,
    planning_model,
)
from greenhouse_gym.planning.goals import Goals
from greenhouse_gym.scene import DIFFICULTIES, Scene, SceneBank, Target
from greenhouse_gym.scene.mjcf import compile_scene

DEFAULT_PLANNERS = ("RRTConnect", "LazyPRM", "LBKPIECE1", "SBL", "BKPIECE1", "PRM", "RRT", "EST", "STRIDE")


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bank", default="default")
    parser.add_argument("--split", default="test")
    parser.add_argument(
        "--targets", type=int, default=60, help="reachable ones, as many of each difficulty as there are"
    )
    parser.add_argument("--planners", nargs="+", default=DEFAULT_PLANNERS, metavar="NAME", help="or: all, paper")
    parser.add_argument("--seeds", type=int, default=3, help="runs per target")
    parser.add_argument("--max-checks", type=int, default=50_000, help="collision checks per plan")
    parser.add_argument("--time-limit", type=float, default=60.0, help="seconds per plan, at most")
    parser.add_argument("--first-solution", action="store_true", help="let no planner improve its first path")
    parser.add_argument(
        "--budget", type=float, default=math.inf,
        help="checks; a planner that has used as many gets no further seed, and fewer runs than the others",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, default=RESULTS / "planners", help="folder")
    arguments = parser.parse_args()
    names = {"all": tuple(PLANNERS), "paper": PAPER_PLANNERS}.get(arguments.planners[0], arguments.planners)
    targets = reachable_targets(SceneBank.open(arguments.bank), arguments.split, arguments.targets)
    arguments.out.mkdir(parents=True, exist_ok=True)
    runs = run_all([PLANNERS[name].name for name in names], targets, arguments)
    rows = summary(runs)
    command = f"benchmarks/planners.py --bank {Path(arguments.bank).name} --split {arguments.split} "
    command += f"--targets {len(targets)} --planners {' '.join(arguments.planners)} --seeds {arguments.seeds} "
    command += f"--max-checks {arguments.max_checks} --time-limit {arguments.time_limit:g}"
    command += " --first-solution" * arguments.first_solution
    command += f" --budget {arguments.budget:g}" * math.isfinite(arguments.budget)
    searches = [run["goal_search_time"] for run in runs if "goal_search_time" in run]
    result = {"command": command, "goal_search_median_s": float(np.median(searches)), "planners": rows}
    write_results(arguments.out / "planners.json", result, ["mujoco", "ompl"])
    text = table(rows)
    write_atomically(arguments.out / "planners.md", f"`{command}`\n\n{text}\n")
    plots(runs, arguments.out)
    planner_arena_database(runs, arguments.out / "planners.db", command)
    print(text)


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


def run_all(
    planners: Sequence[str], targets: Sequence[tuple[Scene, Target]], arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    """All runs asked for, those on file among them."""
    file: Path = arguments.out / "runs.jsonl"
    lines = file.read_text().splitlines() if file.exists() else []
    done = {_key(run): run for run in map(json.loads, lines)}
    # a bank built anew has new scenes under old names
    scenes = {scene.name: scene for scene, _ in targets}
    hashes = {name: sha256(scene.model_dump_json().encode()).hexdigest()[:8] for name, scene in scenes.items()}
    goals: dict[tuple[str, int], tuple[Goals, float]] = {}
    runs: list[dict[str, Any]] = []
    with file.open("a") as out:
        for seed in range(arguments.seeds):
            used = Counter[str]()
            for run in runs:
                used[run["planner"]] += run["checks"]
            asked = [(p, *target) for target in targets for p in planners if used[p] < arguments.budget]
            for planner, scene, target in track(asked, description=f"planning, seed {seed}"):
                wanted = {"planner": planner, "scene": scene.name, "target": target.tomato, "seed": seed}
                wanted |= {
                    "scene_hash": hashes[scene.name],
                    "max_checks": arguments.max_checks,
                    "time_limit": arguments.time_limit,
                    "first_solution": arguments.first_solution,
                }
                run = done.get(_key(wanted))
                if run is None:
                    where = (scene.name, target.tomato)
                    if where not in goals:
                        began = time.perf_counter()
                        found = goal_configurations(scene, target.tomato)
                        goals[where] = found, round(time.perf_counter() - began, 4)
                    run = {**wanted, "difficulty": target.difficulty, **measure(scene, wanted, *goals[where])}
                    out.write(json.dumps(run) + "\n")
                    out.flush()
                runs.append(run)
    return runs


def _key(run: dict[str, Any]) -> tuple[Any, ...]:
    keys = ("planner", "scene", "scene_hash", "target", "seed", "max_checks", "time_limit", "first_solution")
    return tuple(run.get(key) for key in keys)


def measure(scene: Scene, wanted: dict[str, Any], goals: Goals, goal_seconds: float) -> dict[str, Any]:
    """One run."""
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
        "costs": result.costs[:: math.ceil(len(result.costs) / 20) or 1].round(4).tolist(),
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


if __name__ == "__main__":
    main()
