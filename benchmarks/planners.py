"""Planners over the targets of a bank, run by run, resumable, with budgets in collision checks.

    python benchmarks/planners.py --planners all --first-solution --budget 2000000   # all planners
    python benchmarks/planners.py --planners RRTConnect SBL --seeds 3 --max-checks 20000 --out results-of-two

The runs at a target are added to OUT/runs.jsonl at once; runs that are there already are not repeated, so an
interrupted benchmark goes on where it stopped and a further seed costs only that seed. From the runs come
OUT/planners.json, planners.md, two plots and planners.db, an SQLite file in the schema of OMPL's benchmarks, which
Planner Arena opens. Times are over all runs, failed ones included. Planners that go on improving their paths use all of
their checks, unless ``--first-solution`` has them stop at the first: runs with it tell how soon, others how good.

What ends a run is the number of its checks, and what leaves a planner out of further seeds is the sum of them, so a
machine with other work on it gives the same paths; only the seconds differ, and the rate of bare checks, measured
beside every run, says by how much. ``--time-limit`` is for planners that check too little to end by their checks
(LazyPRMstar) or that do not look at them: it decides nothing as long as it is generous.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from planner_reports import planner_arena_database, plots, summary, table
from results_file import RESULTS, write_results

from greenhouse_gym.common.executors import BACKENDS, executor_for
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.planning import PAPER_PLANNERS, PLANNERS
from greenhouse_gym.planning.planner_sweep import SweepSettings, reachable_targets, sweep_planners
from greenhouse_gym.scene import SceneBank

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
    parser.add_argument("--backend", choices=BACKENDS, default="serial", help="others disturb each other's seconds")
    parser.add_argument("--workers", type=int, help="processes; one per core by default")
    parser.add_argument("--address", default="local", help="of the Ray cluster")
    parser.add_argument("--out", type=Path, default=RESULTS / "planners", help="folder")
    arguments = parser.parse_args()
    names = {"all": tuple(PLANNERS), "paper": PAPER_PLANNERS}.get(arguments.planners[0], arguments.planners)
    targets = reachable_targets(SceneBank.open(arguments.bank), arguments.split, arguments.targets)
    arguments.out.mkdir(parents=True, exist_ok=True)
    settings = SweepSettings(
        arguments.seeds, arguments.max_checks, arguments.time_limit, arguments.first_solution, arguments.budget
    )
    with executor_for(arguments.backend, arguments.workers, arguments.address) as executor:
        runs = sweep_planners(
            [PLANNERS[name].name for name in names], targets, settings, arguments.out / "runs.jsonl", executor,
            lambda what, done, of: print(f"{what}: {done} of {of} targets", flush=True),
        )  # fmt: skip
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


if __name__ == "__main__":
    main()
