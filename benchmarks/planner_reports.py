"""What the runs of benchmarks/planners.py say: a summary, a Markdown table, plots, a database for Planner Arena."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Sequence
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from results_file import processor

from greenhouse_gym.evaluation import wilson_interval
from greenhouse_gym.planning import PAPER_PLANNERS, PLANNERS

Run = dict[str, Any]


_ENOUGH = 300  # checks of a run, for its rate to mean anything


def _by_planner(runs: Iterable[Run]) -> dict[str, list[Run]]:
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run["planner"], []).append(run)
    return dict(sorted(groups.items()))


def _median(runs: Iterable[Run], key: str) -> float | None:
    values = [run[key] for run in runs if run[key] is not None]
    return float(np.median(values)) if values else None


def summary(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """A row per planner."""
    rows = []
    for name, group in _by_planner(runs).items():
        solved = [run for run in group if run["status"] == "solved"]
        statuses = sorted({run["status"] for run in group})
        for run in group:
            run["rate"] = run["checks"] / run["planning_time"] if run["checks"] >= _ENOUGH else None
            run["share"] = run["rate"] / run["bare_rate"] if run["rate"] else None
        rows.append(
            {
                "planner": name,
                "of_the_paper": name in PAPER_PLANNERS,
                "state": _state(group, len(solved)),
                "reproducible": PLANNERS[name].reproducible,
                "runs": len(group),
                "success": len(solved) / len(group),
                "success_95": wilson_interval(len(solved), len(group)),
                "success_by_difficulty": {
                    difficulty: float(
                        np.mean([r["status"] == "solved" for r in group if r["difficulty"] == difficulty])
                    )
                    for difficulty in dict.fromkeys(run["difficulty"] for run in group)
                },
                "statuses": {status: sum(run["status"] == status for run in group) for status in statuses},
                "first_solution_median_s": _median(solved, "first_solution_time"),
                "planning_time_median_s": _median(group, "planning_time"),
                "planning_time_95_s": float(np.quantile([run["planning_time"] for run in group], 0.95)),
                "planning_time_median_by_difficulty_s": {
                    difficulty: _median((r for r in group if r["difficulty"] == difficulty), "planning_time")
                    for difficulty in dict.fromkeys(run["difficulty"] for run in group)
                },
                "planning_time_median_easy_and_medium_s": _median(
                    (r for r in group if r["difficulty"] != "hard"), "planning_time"
                ),
                "checks_median": _median(group, "checks"),
                "checks_per_second_median": _median(group, "rate"),
                "share_of_bare_rate_median": _median(group, "share"),
                "raw_length_median_rad": _median(solved, "raw_length"),
                "length_median_rad": _median(solved, "length"),
                "clearance_median_m": _median(solved, "clearance"),
                "smoothness_median": _median(solved, "smoothness"),
                "tree_size_median": _median(group, "tree_size"),
            }
        )
    return rows


def _share_solved(runs: Iterable[Run]) -> float:
    return float(np.mean([run["status"] == "solved" for run in runs]))


def _state(group: Sequence[Run], solved: int) -> str:
    if solved:
        return "solves"
    failed = [run for run in group if run["status"] in ("crashed", "timeout")]
    return failed[0]["message"] if len(failed) == len(group) else "solves none here"


def table(rows: Sequence[dict[str, Any]]) -> str:
    """A Markdown table; planners of the paper have a star."""
    heads = [
        "planner",
        "runs",
        "success [95 %]",
        "easy / medium / hard",
        "first s",
        "planning s",
        "easy / medium / hard",
    ]
    heads += ["checks", "raw rad", "rad"]
    heads += ["clearance mm", "smoothness", "timeouts", "crashes", "of bare rate", "same seed, same path"]
    lines = ["| " + " | ".join(heads) + " |", "|---" + "|---:" * (len(heads) - 1) + "|"]

    def number(value: float | None, form: str) -> str:
        return "" if value is None else format(value, form)

    for r in rows:
        low, high = r["success_95"]
        by, times = r["success_by_difficulty"], r["planning_time_median_by_difficulty_s"]
        cells = [
            r["planner"] + ("\\*" if r["of_the_paper"] else ""),
            str(r["runs"]),
            f"{r['success']:.0%} [{low:.0%}, {high:.0%}]",
            " / ".join(number(by.get(d), ".0%") or "-" for d in ("easy", "medium", "hard")),
            number(r["first_solution_median_s"], ".3f"),
            number(r["planning_time_median_s"], ".3f"),
            " / ".join(number(times.get(d), ".3f") or "-" for d in ("easy", "medium", "hard")),
            number(r["checks_median"], ".0f"),
            number(r["raw_length_median_rad"], ".2f"),
            number(r["length_median_rad"], ".2f"),
            number(r["clearance_median_m"] and 1000 * r["clearance_median_m"], ".0f"),
            number(r["smoothness_median"], ".1f"),
            str(r["statuses"].get("timeout", 0)),
            str(r["statuses"].get("crashed", 0)),
            number(r["share_of_bare_rate_median"], ".2f"),
            "yes" if r["reproducible"] else "no",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def plots(runs: Sequence[Run], folder: Path) -> None:
    """Share of runs solved over time, and length over time of the planners that improve their paths."""
    groups = _by_planner(runs)
    grid = np.geomspace(0.005, max(run["time_limit"] for run in runs), 80)
    shares, lengths = {}, {}
    for name in sorted(groups, key=lambda n: -sum(r["status"] == "solved" for r in groups[n])):
        solved = [r for r in groups[name] if r["status"] == "solved"]
        if solved:
            times = np.sort([r["first_solution_time"] for r in solved])
            shares[name] = 100 * np.searchsorted(times, grid, side="right") / len(groups[name])
        if solved and PLANNERS[name].optimizing:
            # runs without a path yet count as endless ones, so a curve begins where half of them have one
            median = np.median([_cost_at(r["costs"], grid) for r in solved], axis=0)
            lengths[name] = np.where(np.isfinite(median), median, np.nan)
    _plot(grid, shares, "runs solved (%)", folder / "solved-over-time.png")
    if lengths:
        label = "length of the best path so far (rad), median of the runs solved in the end"
        _plot(grid, lengths, label, folder / "length-over-time.png")


def _plot(grid: Any, curves: dict[str, Any], label: str, path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for i, (name, curve) in enumerate(curves.items()):
        axes.plot(grid, curve, label=name, linestyle=("-", "--", ":", "-.")[i // 10 % 4], color=f"C{i % 10}")
    axes.set(xscale="log", xlabel="seconds", ylabel=label)
    axes.legend(fontsize=7, frameon=False, ncol=1 + len(curves) // 20, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(path, dpi=110)


def _cost_at(costs: Sequence[tuple[float, float]], grid: Any) -> Any:
    times = np.array([time for time, _ in costs])
    values = np.array([np.inf, *(cost for _, cost in costs)])
    return values[np.searchsorted(times, grid, side="right")]


_SCHEMA = """
CREATE TABLE experiments (id INTEGER PRIMARY KEY ON CONFLICT REPLACE AUTOINCREMENT, name VARCHAR(512),
    totaltime REAL, timelimit REAL, memorylimit REAL, runcount INTEGER, version VARCHAR(128), hostname VARCHAR(1024),
    cpuinfo TEXT, date DATETIME, seed INTEGER, setup TEXT);
CREATE TABLE plannerConfigs (id INTEGER PRIMARY KEY ON CONFLICT REPLACE AUTOINCREMENT,
    name VARCHAR(512) NOT NULL ON CONFLICT FAIL, settings TEXT);
CREATE TABLE enums (name VARCHAR(512), value INTEGER, description TEXT, PRIMARY KEY (name, value));
CREATE TABLE runs (id INTEGER PRIMARY KEY AUTOINCREMENT, experimentid INTEGER, plannerid INTEGER,
    time REAL, simplification_time REAL, solved BOOLEAN, approximate_solution BOOLEAN, status ENUM,
    time_to_first_solution REAL, collision_checks INTEGER, graph_states INTEGER, solution_length REAL,
    simplified_solution_length REAL, simplified_solution_clearance REAL, simplified_solution_smoothness REAL,
    solution_smoothness REAL, random_seed INTEGER,
    FOREIGN KEY (experimentid) REFERENCES experiments(id) ON DELETE CASCADE,
    FOREIGN KEY (plannerid) REFERENCES plannerConfigs(id) ON DELETE CASCADE);
CREATE TABLE progress (runid INTEGER, time REAL, best_cost REAL, PRIMARY KEY (runid, time),
    FOREIGN KEY (runid) REFERENCES runs(id) ON DELETE CASCADE);
"""
_STATUSES = {
    "solved": (6, "Exact solution"), "approximate": (5, "Approximate solution"), "no_solution": (4, "Timeout"),
    "timeout": (4, "Timeout"), "crashed": (7, "Crash"), "invalid": (0, "Unknown status"),
    "no_goal": (2, "Invalid goal"), "start_in_collision": (1, "Invalid start"),
}  # fmt: skip


def planner_arena_database(runs: Sequence[Run], path: Path, setup: str) -> None:
    """Write runs as the SQLite file that OMPL's ``ompl_benchmark_statistics`` makes and Planner Arena reads.

    A target is an experiment, and so is a time limit.
    """
    path.unlink(missing_ok=True)
    connection = sqlite3.connect(path)
    connection.executescript(_SCHEMA)
    connection.executemany("INSERT INTO enums VALUES ('status', ?, ?)", sorted(set(_STATUSES.values())))
    groups: dict[tuple[str, float], list[Run]] = {}
    for run in runs:
        key = (f"{run['scene']}, tomato {run['target']} ({run['difficulty']})", run["time_limit"])
        groups.setdefault(key, []).append(run)
    planners = {}
    for name in _by_planner(runs):
        settings = json.dumps(dict(PLANNERS[name].settings))
        cursor = connection.execute("INSERT INTO plannerConfigs (name, settings) VALUES (?, ?)", (name, settings))
        planners[name] = cursor.lastrowid
    for (name, limit), group in groups.items():
        date = datetime.now().isoformat(" ", "seconds")
        values = (name, sum(r["planning_time"] for r in group), limit, 4096.0, len({r["seed"] for r in group}),
                  f"OMPL {version('ompl')}", "", processor(), date, 0, setup)  # fmt: skip
        marks = ",".join("?" * len(values))
        columns = "name, totaltime, timelimit, memorylimit, runcount, version, hostname, cpuinfo, date, seed, setup"
        experiment = connection.execute(f"INSERT INTO experiments ({columns}) VALUES ({marks})", values).lastrowid
        for r in group:
            _insert_run(connection, experiment, planners[r["planner"]], r)
    connection.commit()
    connection.close()


def _insert_run(connection: sqlite3.Connection, experiment: int | None, planner: int | None, r: Run) -> None:
    row = {
        "experimentid": experiment, "plannerid": planner, "time": r["planning_time"],
        "simplification_time": r["simplification_time"], "solved": r["status"] == "solved",
        "approximate_solution": r["status"] == "approximate", "status": _STATUSES[r["status"]][0],
        "time_to_first_solution": r["first_solution_time"], "collision_checks": r["checks"],
        "graph_states": r["tree_size"], "solution_length": r["raw_length"],
        "simplified_solution_length": r["length"], "simplified_solution_clearance": r["clearance"],
        "simplified_solution_smoothness": r["smoothness"], "solution_smoothness": r["raw_smoothness"],
        "random_seed": r["seed"],
    }  # fmt: skip
    marks = ",".join("?" * len(row))
    run = connection.execute(f"INSERT INTO runs ({', '.join(row)}) VALUES ({marks})", tuple(row.values())).lastrowid
    costs = [(run, seconds, cost) for seconds, cost in r["costs"]]
    connection.executemany("INSERT OR IGNORE INTO progress VALUES (?, ?, ?)", costs)
