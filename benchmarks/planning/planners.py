"""Compare planners on the targets of a bank with budgets in collision checks; runs are kept and resumed.

python -m benchmarks.planning.planners --planners all --first-solution --budget 2000000
python -m benchmarks.planning.planners --planners RRTConnect SBL --seeds 3 --max-checks 20000 --out results-of-two

The runs at a target are added to OUT/runs.jsonl at once and not repeated, so an interrupted benchmark resumes, and a
further seed costs only that seed. From the runs come OUT/planners.json, planners.md, two plots, and planners.db, an
SQLite file in the schema of OMPL's benchmarks, which Planner Arena opens. Times are over all runs, failed ones
included. Planners that improve their paths use all of their checks unless ``--first-solution`` is given.

Runs end by the number of their checks, and planners are left out of further seeds by the sum of them, so a busy machine
gives the same paths. Only the seconds differ; the rate of bare checks, measured next to every run, shows by how much.
``--time-limit`` is for planners that hardly check anything (LazyPRMstar) or ignore the checks; it must be generous.
Takes 4 hours for all planners with three seeds.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from benchmarks.common import RESULTS, command_line, parser, write_results
from benchmarks.planning.planner_figures import markdown, planner_arena_database, plots, summary
from greenhouse_gym.common.executors import BACKENDS, executor_for
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.planning import PAPER_PLANNERS, PLANNERS
from greenhouse_gym.planning.planner_sweep import SweepSettings, reachable_targets, sweep_planners
from greenhouse_gym.scene import SceneBank

DEFAULT_PLANNERS = ("RRTConnect", "LazyPRM", "LBKPIECE1", "SBL", "BKPIECE1", "PRM", "RRT", "EST", "STRIDE")


def main() -> None:
    """Run the benchmark."""
    command = parser(__doc__)
    command.add_argument("--bank", default="default")
    command.add_argument("--split", default="test")
    command.add_argument("--targets", type=int, default=60, help="reachable ones, equally many of each difficulty")
    command.add_argument("--planners", nargs="+", default=DEFAULT_PLANNERS, metavar="NAME", help="or: all, paper")
    command.add_argument("--seeds", type=int, default=3, help="runs per target")
    command.add_argument("--max-checks", type=int, default=50_000, help="collision checks per plan")
    command.add_argument("--time-limit", type=float, default=60.0, help="seconds per plan")
    command.add_argument("--first-solution", action="store_true", help="let no planner improve its first path")
    command.add_argument(
        "--budget", type=float, default=math.inf, help="checks after which a planner gets no more seeds"
    )
    command.add_argument("--backend", choices=BACKENDS, default="serial", help="parallel runs disturb the times")
    command.add_argument("--workers", type=int, help="processes; one per core by default")
    command.add_argument("--address", default="local", help="of the Ray cluster")
    command.add_argument("--out", type=Path, default=RESULTS / "planners", help="folder")
    a = command.parse_args()
    names = {"all": tuple(PLANNERS), "paper": PAPER_PLANNERS}.get(a.planners[0], a.planners)
    targets = reachable_targets(SceneBank.open(a.bank), a.split, a.targets)
    a.out.mkdir(parents=True, exist_ok=True)
    settings = SweepSettings(a.seeds, a.max_checks, a.time_limit, a.first_solution, a.budget)
    with executor_for(a.backend, a.workers, a.address) as executor:
        runs = sweep_planners(
            [PLANNERS[name].name for name in names], targets, settings, a.out / "runs.jsonl", executor,
            lambda what, done, of: print(f"{what}: {done} of {of} targets", flush=True),
        )  # fmt: skip
    rows = summary(runs)
    searches = [run["goal_search_time"] for run in runs if "goal_search_time" in run]
    write_results(a.out / "planners.json", {"goal_search_median_s": float(np.median(searches)), "planners": rows})
    write_atomically(a.out / "planners.md", f"`python -m {command_line()}`\n\n{markdown(rows)}\n")
    plots(runs, a.out)
    planner_arena_database(runs, a.out / "planners.db", command_line())
    print(markdown(rows))


if __name__ == "__main__":
    main()
