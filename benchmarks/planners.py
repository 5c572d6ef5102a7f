"""OMPL's planners over the targets of a bank: success, times, checks per second inside OMPL and in a bare loop.

    python benchmarks/planners.py --bank scenes/mini --targets 60 --planners RRTConnect BiEST KPIECE1

Writes benchmarks/results/planners.json and prints a table. Times are over all runs, failed ones included.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from results_file import RESULTS, write_results
from rich.progress import track

from greenhouse_gym.planning import PLANNERS, CollisionChecker, plan, planning_model
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.mjcf import compile_scene

DEFAULT_PLANNERS = ("RRTConnect", "LazyPRM", "LBKPIECE1", "SBL", "BKPIECE1", "PRM", "RRT", "EST", "STRIDE")


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bank", default="default")
    parser.add_argument("--split", default="test")
    parser.add_argument("--targets", type=int, default=60, help="targets, spread evenly over the split")
    parser.add_argument("--planners", nargs="+", default=DEFAULT_PLANNERS, choices=tuple(PLANNERS), metavar="NAME")
    parser.add_argument("--time-limit", type=float, default=5.0, help="seconds per plan")
    parser.add_argument("--out", type=Path, default=RESULTS / "planners.json")
    arguments = parser.parse_args()
    targets = reachable_targets(SceneBank.open(arguments.bank), arguments.split, arguments.targets)
    bare = bare_checks_per_second(targets)
    rows = [measure(name, targets, arguments.time_limit, bare) for name in arguments.planners]
    result = {
        "command": f"benchmarks/planners.py --bank {Path(arguments.bank).name} --targets {len(targets)} "
        f"--time-limit {arguments.time_limit:g}",
        "bare_checks_per_second": bare,
        "planners": rows,
    }
    write_results(arguments.out, result, ["mujoco", "ompl"])
    print(table(rows))


def reachable_targets(bank: SceneBank, split: str, count: int) -> list[tuple[Scene, int]]:
    """At most ``count`` reachable targets, evenly spread over the scenes of a split."""
    scenes = [bank.scene(name) for name in bank.names(split)]
    every = [(scene, t.tomato) for scene in scenes for t in scene.targets if t.difficulty != "unreachable"]
    chosen = np.unique(np.linspace(0, len(every) - 1, min(count, len(every))).round().astype(int))
    return [every[i] for i in chosen]


def bare_checks_per_second(targets: Sequence[tuple[Scene, int]], configurations: int = 2000) -> float:
    """Checks per second of MuJoCo alone, over random configurations in the same scenes."""
    rng, checks, seconds = np.random.default_rng(0), 0, 0.0
    for scene, target in targets:
        compiled = compile_scene(scene)
        model = CollisionChecker(planning_model(compiled, target)).model
        data = mujoco.MjData(model)
        qpos = data.qpos
        batch = rng.uniform(compiled.robot.lower, compiled.robot.upper, (configurations, model.nv))
        began = time.perf_counter()
        for configuration in batch:
            qpos[:] = configuration
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
        seconds += time.perf_counter() - began
        checks += configurations
    return checks / seconds


def measure(planner: str, targets: Sequence[tuple[Scene, int]], time_limit: float, bare: float) -> dict[str, Any]:
    """Plan to every target with one planner."""
    results = [
        plan(scene, target, planner=planner, time_limit=time_limit, seed=seed)
        for seed, (scene, target) in enumerate(track(targets, description=planner))
    ]
    times = [r.planning_time for r in results]
    solved = [r for r in results if r.path is not None]
    statuses = sorted({r.status for r in results})
    rate = sum(r.checks for r in results) / sum(times)
    return {
        "planner": planner,
        "targets": len(results),
        "success": len(solved) / len(results),
        "statuses": {status: sum(r.status == status for r in results) for status in statuses},
        "planning_time_median_s": float(np.median(times)),
        "planning_time_95_s": float(np.quantile(times, 0.95)),
        "simplification_time_median_s": _median([r.simplification_time for r in solved]),
        "goal_time_median_s": _median([r.goal_time for r in results]),
        "checks_median": _median([r.checks for r in results]),
        "checks_per_second": rate,
        "share_of_bare_rate": rate / bare,
        "length_median_rad": _median([r.length for r in solved]),
    }


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def table(rows: Sequence[dict[str, Any]]) -> str:
    """A Markdown table of the main numbers."""
    lines = ["| planner | success | median s | 95 % s | checks | checks/s | of bare | length rad |"]
    lines.append("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for r in rows:
        length = "" if r["length_median_rad"] is None else f"{r['length_median_rad']:.2f}"
        lines.append(
            f"| {r['planner']} | {r['success']:.1%} | {r['planning_time_median_s']:.4f} | {r['planning_time_95_s']:.3f}"
            f" | {r['checks_median']:.0f} | {r['checks_per_second']:.0f} | {r['share_of_bare_rate']:.2f} | {length} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
