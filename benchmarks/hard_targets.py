"""How many of the bank's hard targets planners reach, with a budget in checks and in a second of processor time.

python benchmarks/hard_targets.py --planners RRTConnect --targets 600 --out hard_targets_rrtconnect.json
python benchmarks/hard_targets.py --planners paper --targets 20

Targets of training and validation scenes, in an order that is always the same, so that fewer are a part of more; all
planners at one target before the next. Every planner stops at its first path, or at its budget. Seconds are those that
the planning process had of a processor while it searched, so other work on the machine makes them a little longer, by
shared caches and cores, but does not count itself. Runs are kept in a file below RUNS and not repeated.
"""

from __future__ import annotations

import argparse
import json
import os
from collections import Counter
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from results_file import RESULTS, write_results

from greenhouse_gym.evaluation.records import wilson_interval
from greenhouse_gym.planning import PAPER_PLANNERS, goal_configurations, plan
from greenhouse_gym.planning.worker import shared_worker
from greenhouse_gym.scene import SceneBank

SPLITS = ("train", "validation")
SECOND = 1.0
Run = dict[str, Any]


def main() -> None:
    """Run the planners and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--planners", nargs="+", default=["RRTConnect"], help="names, or: paper")
    parser.add_argument("--targets", type=int, default=600)
    parser.add_argument("--max-checks", type=int, default=40_000)
    parser.add_argument("--time-limit", type=float, default=30.0, help="of the wall, for those that check little")
    parser.add_argument("--out", default="hard_targets.json", help="file among the results")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder for the file of the single runs")
    a = parser.parse_args()
    planners = list(PAPER_PLANNERS) if a.planners == ["paper"] else a.planners
    a.runs.mkdir(parents=True, exist_ok=True)
    kept = a.runs / f"{a.out}l"
    runs: list[Run] = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    done = {(run["planner"], run["scene"], run["target"], run["max_checks"]) for run in runs}
    bank = SceneBank.open("default")
    targets = hard_targets(bank, a.targets)
    command = f"benchmarks/hard_targets.py --planners {' '.join(a.planners)} --targets {len(targets)} "
    command += f"--max-checks {a.max_checks} --time-limit {a.time_limit:g} --out {a.out}"
    with kept.open("a") as file:
        for count, (name, target) in enumerate(targets, 1):
            missing = [planner for planner in planners if (planner, name, target, a.max_checks) not in done]
            if not missing:
                continue
            scene = bank.scene(name)
            goals = goal_configurations(scene, target)
            for planner in missing:
                pid, before = shared_worker().pid, seconds_of_worker()
                result = plan(
                    scene, target, planner=planner, time_limit=a.time_limit, max_checks=a.max_checks, goals=goals,
                    first_solution=True,
                )  # fmt: skip
                whole = result.planning_time + result.simplification_time
                spent = seconds_of_worker() - before if pid and shared_worker().pid == pid else whole
                searching = result.planning_time / max(whole, 1e-9)
                run = {
                    "planner": planner, "scene": name, "target": target, "max_checks": a.max_checks,
                    "status": result.status, "checks": result.checks, "seconds": round(spent * searching, 3),
                }  # fmt: skip
                runs.append(run)
                file.write(json.dumps(run) + "\n")
                file.flush()
            if count % 5 == 0:
                write(runs, command, a.max_checks, RESULTS / a.out)
                print(f"{count} of {len(targets)} targets", flush=True)
    write(runs, command, a.max_checks, RESULTS / a.out)


def hard_targets(bank: SceneBank, count: int) -> list[tuple[str, int]]:
    """Names of scenes with hard targets; files are read plainly, for scenes take fifty times as long."""
    every = [
        (entry.name, target["tomato"])
        for split in SPLITS
        for entry in bank.manifest.scenes
        if entry.split == split
        for target in json.loads((bank.path / entry.file).read_bytes())["targets"]
        if target["difficulty"] == "hard"
    ]
    order = np.random.default_rng(0).permutation(len(every))[:count]
    return [every[i] for i in order]


def seconds_of_worker() -> float:
    """Processor time of the planning process so far (Linux); 0 where none runs."""
    pid = shared_worker().pid
    if pid is None:
        return 0.0
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def write(runs: list[Run], command: str, max_checks: int, out: Path) -> None:
    """Write what there is; runs of other commands in the same file count too."""
    rows = []
    for planner in sorted({run["planner"] for run in runs}):
        mine = [run for run in runs if run["planner"] == planner and run["max_checks"] == max_checks]
        if not mine:
            continue
        solved = [run for run in mine if run["status"] == "solved"]
        soon = [run for run in solved if run["seconds"] <= SECOND]
        rows.append(
            {
                "planner": planner,
                "targets": len(mine),
                "solved by checks": share(len(solved), len(mine)),
                "solved in 1 s": share(len(soon), len(mine)),
                "statuses": dict(Counter(run["status"] for run in mine)),
                "median seconds": median(run["seconds"] for run in mine),
                "checks per second": round(
                    sum(run["checks"] for run in mine) / max(sum(run["seconds"] for run in mine), 1e-9)
                ),
            }
        )
    result: dict[str, Any] = {"command": command, "splits": SPLITS, "max_checks": max_checks, "planners": rows}
    paper = [row for row in rows if row["planner"] in PAPER_PLANNERS]
    if len(paper) == len(PAPER_PLANNERS):
        for figure in ("solved by checks", "solved in 1 s"):
            result[f"median of the paper's planners, {figure}"] = median(row[figure]["rate"] for row in paper)
    result["load at the end"] = round(os.getloadavg()[0], 1)
    write_results(out, result, ["mujoco", "ompl"])


def share(part: int, whole: int) -> dict[str, Any]:
    """A rate with its 95 % interval."""
    low, high = wilson_interval(part, whole)
    return {"rate": round(part / whole, 4), "95 %": [round(low, 4), round(high, 4)]}


if __name__ == "__main__":
    main()
