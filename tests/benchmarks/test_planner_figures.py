"""Figures of benchmarks/planning/planners.py: a few runs, and OMPL's own statistics script if it is installed."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT))
    from benchmarks.planning import planner_figures

    return planner_figures


def run(planner: str, status: str, seed: int = 0, target: int = 3, **more: Any) -> dict[str, Any]:
    numbers = {
        "planning_time": 0.2, "simplification_time": 0.01, "checks": 4000, "tree_size": 50, "raw_length": 5.0,
        "length": 4.0, "clearance": 0.02, "smoothness": 0.5, "raw_smoothness": 3.0, "first_solution_time": 0.1,
        "costs": [[0.1, 6.0], [0.2, 5.0]],
    }  # fmt: skip
    if status != "solved":
        numbers |= dict.fromkeys(("raw_length", "length", "clearance", "smoothness", "raw_smoothness"))
        numbers |= {"first_solution_time": None, "costs": []}
    where = {"planner": planner, "scene": "row-1", "target": target, "seed": seed, "time_limit": 5.0}
    return {**where, "difficulty": "easy", "status": status, "message": "", "bare_rate": 40_000, **numbers, **more}


@pytest.fixture
def runs() -> list[dict[str, Any]]:
    return [
        run("RRTConnect", "solved"),
        run("RRTConnect", "no_solution", seed=1),
        run("RRTConnect", "solved", target=4),
        run("RRTstar", "timeout"),
        run("RRTstar", "crashed", seed=1, message="RRTstar: died"),
    ]


def test_the_summary_counts_what_failed_and_how(figures: ModuleType, runs: list[dict[str, Any]]) -> None:
    star, connect = sorted(figures.summary(runs), key=lambda row: row["success"])
    assert connect["success"] == pytest.approx(2 / 3)
    assert connect["fraction_of_bare_rate_median"] == pytest.approx(0.5)
    assert star["statuses"] == {"crashed": 1, "timeout": 1}
    assert star["success"] == 0
    lines = figures.markdown([connect, star]).splitlines()
    assert lines[2].startswith("| RRTConnect\\* | 3 | 67% [")
    assert "| 1 | 1 |" in lines[3]


def test_the_database_is_what_planner_arena_reads(
    figures: ModuleType, runs: list[dict[str, Any]], tmp_path: Path
) -> None:
    path = tmp_path / "planners.db"
    figures.planner_arena_database(runs, path, "a command")
    figures.planner_arena_database(runs, path, "a command")  # replaces the first
    connection = sqlite3.connect(path)
    tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    assert {"experiments", "plannerConfigs", "enums", "runs", "progress"} <= tables
    solved = "SELECT name, SUM(solved), COUNT(*) FROM runs JOIN plannerConfigs p ON plannerid = p.id GROUP BY name"
    assert connection.execute(solved).fetchall() == [("RRTConnect", 2, 3), ("RRTstar", 0, 2)]
    assert connection.execute("SELECT COUNT(*) FROM experiments").fetchone() == (2,)
    assert connection.execute("SELECT COUNT(*) FROM progress").fetchone() == (4,)
    (settings,) = connection.execute("SELECT settings FROM plannerConfigs WHERE name = 'RRTConnect'").fetchone()
    assert json.loads(settings)["range"] == 0.8
    assert connection.execute("PRAGMA foreign_key_check").fetchall() == []
    connection.close()
    ompl = find_spec("ompl")  # of OMPL itself: asking for a part of it would import it
    if ompl is None or not Path(str(ompl.origin)).with_name("ompl_benchmark_statistics.py").exists():
        pytest.skip("this OMPL comes without its statistics script")
    script = [sys.executable, "-m", "ompl.ompl_benchmark_statistics", "-d", str(path), "--view", "--mysql"]
    subprocess.run(script, check=True, capture_output=True)
    connection = sqlite3.connect(path)
    assert len(connection.execute("SELECT * FROM bestPlannerConfigsPerExperiment").fetchall()) == 3
    connection.close()
