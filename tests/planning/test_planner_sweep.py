"""Sweeps of planners: the runs do not depend on the machine or the executor, and a sweep resumes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from parallel_helpers import Elsewhere

from greenhouse_gym.planning import planner_sweep
from greenhouse_gym.planning.planner_sweep import Run, SweepSettings, sweep_planners
from greenhouse_gym.scene import Scene

USUAL = SweepSettings(seeds=3, max_checks=5000, time_limit=9.0, first_solution=True)


def test_budgets_are_checks_and_runs_are_not_repeated(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured: list[Run] = []

    def measure(scene: Scene, wanted: Run, *goals: Any) -> Run:
        measured.append(wanted)
        slow = 100.0 * len(measured)  # a machine that gets slower and slower changes nothing
        return {"status": "solved", "checks": 1000, "planning_time": slow, "simplification_time": slow}

    monkeypatch.setattr(planner_sweep, "measure", measure)
    monkeypatch.setattr(planner_sweep, "goal_configurations", lambda *_: None)
    targets = [(scene, scene.targets[0]), (scene, scene.targets[1])]

    def run(**changed: Any) -> int:
        return len(sweep_planners(["RRTConnect"], targets, replace(USUAL, **changed), tmp_path / "runs.jsonl"))

    assert run(budget=1500) == 2  # two runs of 1,000 checks: no further seed
    assert run(budget=2500) == 4
    assert run() == 6
    assert len(measured) == 6
    assert run(max_checks=6000) == 6
    assert len(measured) == 12


def untimed(runs: list[Run]) -> list[Run]:
    """Runs without what is measured in seconds."""
    timed = (
        "planning_time",
        "simplification_time",
        "goal_time",
        "goal_search_time",
        "bare_rate",
        "first_solution_time",
        "costs",
    )
    return [{key: value for key, value in run.items() if key not in timed} for run in runs]


def test_runs_made_elsewhere_are_the_same(scene: Scene, tmp_path: Path) -> None:
    targets = [(scene, target) for target in scene.targets[:3]]
    settings = replace(USUAL, seeds=1, max_checks=2000)
    here, there = (
        sweep_planners(["ShortcutConnect", "RRTConnect"], targets, settings, tmp_path / f"{name}.jsonl", executor)
        for name, executor in (("here", None), ("there", Elsewhere()))
    )
    assert untimed(here) == untimed(there)
    assert [(run["target"], run["planner"]) for run in here] == [
        (target.tomato, planner) for _, target in targets for planner in ("ShortcutConnect", "RRTConnect")
    ]
    elsewhere = Elsewhere()
    again = sweep_planners(["ShortcutConnect", "RRTConnect"], targets, settings, tmp_path / "there.jsonl", elsewhere)
    assert again == there
    assert elsewhere.works == []
