"""benchmarks/planners.py: what is run does not depend on how fast the machine is, and goes on where it stopped."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from greenhouse_gym.scene import Scene

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import planners

    return planners


def test_budgets_are_checks_and_runs_are_not_repeated(
    benchmark: ModuleType, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured: list[dict[str, Any]] = []

    def measure(scene: Scene, wanted: dict[str, Any], *goals: Any) -> dict[str, Any]:
        measured.append(wanted)
        slow = 100.0 * len(measured)  # a machine that gets slower and slower changes nothing
        return {"status": "solved", "checks": 1000, "planning_time": slow, "simplification_time": slow}

    monkeypatch.setattr(benchmark, "measure", measure)
    monkeypatch.setattr(benchmark, "goal_configurations", lambda *_: None)
    targets = [(scene, scene.targets[0]), (scene, scene.targets[1])]

    def run(**changed: Any) -> int:
        usual = {"seeds": 3, "budget": math.inf, "max_checks": 5000, "time_limit": 9.0, "first_solution": True}
        arguments = argparse.Namespace(out=tmp_path, **{**usual, **changed})
        return len(benchmark.run_all(["RRTConnect"], targets, arguments))

    assert run(budget=1500) == 2  # two runs of 1,000 checks: no further seed
    assert run(budget=2500) == 4
    assert run() == 6
    assert len(measured) == 6
    assert run(max_checks=6000) == 6
    assert len(measured) == 12
