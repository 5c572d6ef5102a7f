"""Figures of `planners.py`: a summary per planner, a Markdown table, plots, and a database for Planner Arena."""

from __future__ import annotations

import json
import sqlite3
from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.common import processor, table
from greenhouse_gym.evaluation.records import wilson_interval
from greenhouse_gym.planning import PAPER_PLANNERS, PLANNERS
from greenhouse_gym.scene import DIFFICULTIES

Run = dict[str, Any]
MIN_CHECKS = 300
"""Checks of a run below which its rate means nothing."""


def _by_planner(runs: Iterable[Run]) -> dict[str, list[Run]]:
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run["planner"], []).append(run)
    return dict(sorted(groups.items()))


def _median(runs: Iterable[Run], key: str) -> float | None:
    values = [run[key] for run in runs if run[key] is not None]
    return float(np.median(values)) if values else None


def summary(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return the figures of every planner."""
    rows = []
    for name, group in _by_planner(runs).items():
        solved = [run for run in group if run["status"] == "solved"]
        by = {d: [run for run in group if run["difficulty"] == d] for d in DIFFICULTIES}
        by = {difficulty: part for difficulty, part in by.items() if part}
        for run in group:
            run["rate"] = run["checks"] / run["planning_time"] if run["checks"] >= MIN_CHECKS else None
            run["fraction_of_bare_rate"] = run["rate"] / run["bare_rate"] if run["rate"] else None
        rows.append(
            {
                "planner": name,
                "of_the_paper": name in PAPER_PLANNERS,
                "reproducible": PLANNERS[name].reproducible,
                "runs": len(group),
                "success": len(solved) / len(group),
                "success_95": wilson_interval(len(solved), len(group)),
                "success_by_difficulty": {
                    d: float(np.mean([run["status"] == "solved" for run in part])) for d, part in by.items()
                },
                "statuses": dict(sorted(Counter(run["status"] for run in group).items())),
                "first_solution_median_s": _median(solved, "first_solution_time"),
                "planning_time_median_s": _median(group, "planning_time"),
                "planning_time_95_s": float(np.quantile([run["planning_time"] for run in group], 0.95)),
                "planning_time_median_by_difficulty_s": {d: _median(part, "planning_time") for d, part in by.items()},
                "checks_median": _median(group, "checks"),
                "checks_per_second_median": _median(group, "rate"),
                "fraction_of_bare_rate_median": _median(group, "fraction_of_bare_rate"),
                "raw_length_median_rad": _median(solved, "raw_length"),
                "length_median_rad": _median(solved, "length"),
                "clearance_median_m": _median(solved, "clearance"),
                "smoothness_median": _median(solved, "smoothness"),
                "tree_size_median": _median(group, "tree_size"),
            }
        )
    return rows


_HEADS = (
    "planner", "runs", "success [95 %]", "easy / medium / hard", "first s", "planning s", "easy / medium / hard",
    "checks", "raw rad", "rad", "clearance mm", "smoothness", "timeouts", "crashes", "of bare rate",
    "same seed, same path",
)  # fmt: skip


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Return a Markdown table of the figures; planners of the paper have a star."""

    def number(value: float | None, form: str) -> str:
        return "" if value is None else format(value, form)

    def by_difficulty(values: dict[str, float | None], form: str) -> str:
        return " / ".join(number(values.get(d), form) or "-" for d in ("easy", "medium", "hard"))

    lines = []
    for r in rows:
        low, high = r["success_95"]
        lines.append(
            (
                r["planner"] + ("\\*" if r["of_the_paper"] else ""),
                r["runs"],
                f"{r['success']:.0%} [{low:.0%}, {high:.0%}]",
                by_difficulty(r["success_by_difficulty"], ".0%"),
                number(r["first_solution_median_s"], ".3f"),
                number(r["planning_time_median_s"], ".3f"),
                by_difficulty(r["planning_time_median_by_difficulty_s"], ".3f"),
                number(r["checks_median"], ".0f"),
                number(r["raw_length_median_rad"], ".2f"),
                number(r["length_median_rad"], ".2f"),
                number(r["clearance_median_m"] and 1000 * r["clearance_median_m"], ".0f"),
                number(r["smoothness_median"], ".1f"),
                *(r["statuses"].get(status, 0) for status in ("timeout", "crashed")),
                number(r["fraction_of_bare_rate_median"], ".2f"),
                "yes" if r["reproducible"] else "no",
            )
        )
    return table(_HEADS, lines)


def plots(runs: Sequence[Run], folder: Path) -> None:
    """Plot the fraction of runs solved over time, and the length over time of planners that improve their paths."""
    groups = _by_planner(runs)
    grid = np.geomspace(0.005, max(run["time_limit"] for run in runs), 80)
    fractions, lengths = {}, {}
    for name in sorted(groups, key=lambda n: -sum(r["status"] == "solved" for r in groups[n])):
        solved = [r for r in groups[name] if r["status"] == "solved"]
        if solved:
            times = np.sort([r["first_solution_time"] for r in solved])
            fractions[name] = 100 * np.searchsorted(times, grid, side="right") / len(groups[name])
        if solved and PLANNERS[name].optimizing:
            # runs without a path yet count as infinitely long, so a curve begins where half of them have one
            median = np.median([_cost_at(r["costs"], grid) for r in solved], axis=0)
            lengths[name] = np.where(np.isfinite(median), median, np.nan)
    _plot(grid, fractions, "runs solved (%)", folder / "solved-over-time.png")
    if lengths:
        label = "length of the best path so far (rad), median of the runs that are solved in the end"
        _plot(grid, lengths, label, folder / "length-over-time.png")


def _plot(grid: Any, curves: dict[str, Any], label: str, path: Path) -> None:
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
_COLUMNS = {
    "time": "planning_time", "simplification_time": "simplification_time",
    "time_to_first_solution": "first_solution_time", "collision_checks": "checks", "graph_states": "tree_size",
    "solution_length": "raw_length", "simplified_solution_length": "length",
    "simplified_solution_clearance": "clearance", "simplified_solution_smoothness": "smoothness",
    "solution_smoothness": "raw_smoothness", "random_seed": "seed",
}  # fmt: skip


def planner_arena_database(runs: Sequence[Run], path: Path, setup: str) -> None:
    """Write runs as the SQLite file that OMPL's ``ompl_benchmark_statistics`` makes and Planner Arena reads.

    Every target and time limit is an experiment.
    """
    path.unlink(missing_ok=True)
    connection = sqlite3.connect(path)
    connection.executescript(_SCHEMA)
    connection.executemany("INSERT INTO enums VALUES ('status', ?, ?)", sorted(set(_STATUSES.values())))
    groups: dict[tuple[str, float], list[Run]] = {}
    for run in runs:
        key = (f"{run['scene']}, tomato {run['target']} ({run['difficulty']})", run["time_limit"])
        groups.setdefault(key, []).append(run)
    planners = {
        name: _insert(connection, "plannerConfigs", name=name, settings=json.dumps(dict(PLANNERS[name].settings)))
        for name in _by_planner(runs)
    }
    for (name, limit), group in groups.items():
        experiment = _insert(
            connection, "experiments", name=name, totaltime=sum(r["planning_time"] for r in group), timelimit=limit,
            hostname="", memorylimit=4096.0, runcount=len({r["seed"] for r in group}), cpuinfo=processor(), seed=0,
            version=f"OMPL {version('ompl')}", date=datetime.now().isoformat(" ", "seconds"), setup=setup,
        )  # fmt: skip
        for r in group:
            run_id = _insert(
                connection, "runs", experimentid=experiment, plannerid=planners[r["planner"]],
                solved=r["status"] == "solved", approximate_solution=r["status"] == "approximate",
                status=_STATUSES[r["status"]][0], **{column: r[key] for column, key in _COLUMNS.items()},
            )  # fmt: skip
            costs = [(run_id, seconds, cost) for seconds, cost in r["costs"]]
            connection.executemany("INSERT OR IGNORE INTO progress VALUES (?, ?, ?)", costs)
    connection.commit()
    connection.close()


def _insert(connection: sqlite3.Connection, into: str, **values: Any) -> int | None:
    marks = ", ".join("?" * len(values))
    return connection.execute(
        f"INSERT INTO {into} ({', '.join(values)}) VALUES ({marks})", [*values.values()]
    ).lastrowid
