"""Planners written in Python: registered, within their budget, and verified like OMPL's."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.agents import PlannerAgent
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.planning import (
    PLANNERS,
    CollisionChecker,
    Goals,
    PlanningProblem,
    PlanResult,
    goal_configurations,
    path_length,
    plan,
    planning_model,
    register_planner,
)
from greenhouse_gym.planning.own_planners import Solve
from greenhouse_gym.planning.planners import _ALL
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import compile_scene


@dataclass(frozen=True)
class TriesSettings:
    tries: int = 3


@pytest.fixture(autouse=True)
def _only_for_the_test() -> Iterator[None]:
    before = dict(_ALL.registered)
    yield
    _ALL.registered.clear()
    _ALL.registered.update(before)


@pytest.fixture(scope="module")
def goals(scene: Scene) -> Goals:
    return goal_configurations(scene, 0, count=10)


def run(scene: Scene, goals: Goals, solve: Solve, **keywords: Any) -> PlanResult:
    register_planner("mine", solve, replace=True)
    return plan(scene, 0, planner="mine", goals=goals, **{"max_checks": 5000, **keywords})


def test_a_registered_planner_is_one_of_all(scene: Scene, goals: Goals) -> None:
    def straight(problem: PlanningProblem, settings: TriesSettings) -> np.ndarray | None:
        for goal in problem.goals[: settings.tries]:
            if problem.motion_is_free(problem.start, goal):
                return np.stack([problem.start, goal])
        return None

    info = register_planner("straight", straight, TriesSettings(), "straight to a goal")
    assert PLANNERS["straight"] is info
    assert "straight" in list(PLANNERS)
    assert list(PLANNERS) == sorted(PLANNERS)
    result = plan(scene, 0, planner="straight", goals=goals, settings={"tries": 10})
    assert result.status == "solved"
    assert result.path is not None
    assert (len(result.path), result.planner) == (2, "straight")
    assert 0 < result.checks == plan(scene, 0, planner="straight", goals=goals, settings={"tries": 10}).checks
    assert result.costs[-1, 1] == pytest.approx(result.length)
    assert PlannerAgent("straight").name == "straight"
    with pytest.raises(UnknownNameError, match=r"setting of straight 'trys'.*Did you mean 'tries'"):
        info.with_settings({"trys": 2})


@pytest.mark.parametrize(
    ("name", "solve"), [("straight", None), ("", lambda p, s: None), ("RRTConnect", lambda p, s: None)]
)
def test_bad_registrations_are_refused(name: str, solve: Any) -> None:
    with pytest.raises(InvalidValueError, match="expected a name that is not taken and a function"):
        register_planner(name, solve)


def test_a_name_is_taken_once() -> None:
    register_planner("mine", lambda problem, settings: None)
    with pytest.raises(InvalidValueError, match="'mine'"):
        register_planner("mine", lambda problem, settings: None)
    register_planner("mine", lambda problem, settings: None, description="new", replace=True)
    assert PLANNERS["mine"].description == "new"


@pytest.mark.parametrize(
    ("path", "problem"),
    [
        (lambda p: np.stack([p.start, p.start + 0.3]), "none of the goals"),
        (lambda p: np.stack([p.start + 0.1, p.goals[0]]), "starts at"),
        (lambda p: np.stack([p.start, np.full_like(p.start, 50.0), p.goals[0]]), "leaves the joint limits"),
        (lambda p: p.start, "shape"),
        (lambda p: np.empty((0, len(p.start))), "shape"),
        (lambda p: np.stack([p.start, np.full_like(p.start, np.nan), p.goals[0]]), "not numbers"),
    ],
)
def test_every_path_is_verified(scene: Scene, goals: Goals, path: Any, problem: str) -> None:
    result = run(scene, goals, lambda p, settings: path(p))
    assert (result.status, result.path) == ("invalid", None)
    assert problem in result.message


def test_a_path_through_an_obstacle_is_invalid(scene: Scene, goals: Goals) -> None:
    checker = CollisionChecker(planning_model(compile_scene(scene), 0))
    blocked = next(
        q
        for q in np.random.default_rng(0).uniform(-1.5, 1.5, (500, 6)) - [0, np.pi / 2, 0, np.pi / 2, 0, 0]
        if not checker.is_free(q)
    )
    blocked = np.clip(blocked, -3.1, 1.5)
    result = run(scene, goals, lambda p, settings: np.stack([p.start, blocked, p.goals[0]]))
    assert (result.status, result.message) == ("invalid", "mine: the path is not free")


def test_errors_and_nonsense_end_in_a_status(scene: Scene, goals: Goals) -> None:
    def broken(problem: PlanningProblem, settings: Any) -> None:
        raise ZeroDivisionError("oh")

    result = run(scene, goals, broken)
    assert (result.status, result.message) == ("crashed", "mine: ZeroDivisionError: oh")
    result = run(scene, goals, lambda p, settings: "nonsense")
    assert result.status == "crashed"
    assert run(scene, goals, lambda p, settings: None).status == "no_solution"


@pytest.mark.parametrize("limits", [{"max_checks": 700, "time_limit": None}, {"max_checks": None, "time_limit": 0.2}])
def test_the_budget_ends_an_endless_planner(scene: Scene, goals: Goals, limits: dict[str, Any]) -> None:
    def endless(problem: PlanningProblem, settings: Any) -> None:
        while True:
            problem.is_free(problem.start)

    result = run(scene, goals, endless, **limits)
    assert result.status == "no_solution"
    assert result.checks > 0
    assert limits["max_checks"] in (None, result.checks)


def test_the_best_reported_path_counts_when_the_budget_ends(scene: Scene, goals: Goals) -> None:
    def reporting(problem: PlanningProblem, settings: Any) -> None:
        for goal in problem.goals:
            if problem.motion_is_free(problem.start, goal):
                problem.report(np.stack([problem.start, goal]))
        while True:
            problem.is_free(problem.start)

    result = run(scene, goals, reporting, max_checks=20_000)
    assert result.status == "solved"
    assert (np.diff(result.costs[:, 1]) < 0).all()


def test_registered_planners_work_without_ompl() -> None:
    code = (
        "import sys; sys.modules['ompl'] = None\n"
        "import importlib.util as u; find = u.find_spec\n"
        "u.find_spec = lambda n, *a: None if n.split('.')[0] == 'ompl' else find(n, *a)\n"
        "from greenhouse_gym.planning import PLANNERS, plan\n"
        "from greenhouse_gym.scene import SceneBank\n"
        "assert list(PLANNERS) == ['ShortcutConnect'], list(PLANNERS)\n"
        "scene = SceneBank.open('mini')[0]\n"
        "easy = next(t.tomato for t in scene.targets if t.difficulty == 'easy')\n"
        "assert plan(scene, easy, planner='ShortcutConnect', max_checks=5000).status == 'solved'\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


# -- the package's own ------------------------------------------------------------------------------------------------


def test_shortcut_connect_is_reproducible_and_free(scene: Scene) -> None:
    first, again, other = (
        plan(scene, 7, planner="ShortcutConnect", time_limit=None, max_checks=8000, seed=seed) for seed in (3, 3, 4)
    )
    assert first.status == again.status == other.status == "solved"
    assert np.array_equal(first.path, again.path)  # type: ignore[arg-type]
    assert first.checks == again.checks
    assert not np.array_equal(first.path, other.path)  # type: ignore[arg-type]
    simulator = CollisionChecker(planning_model(compile_scene(scene), 7, margin=0.0))
    assert first.path is not None
    for a, b in pairwise(first.path):
        assert all(map(simulator.is_free, a + np.linspace(0, 1, 400)[:, None] * (b - a)))


def test_shortcut_connect_gets_shorter_with_more_checks(scene: Scene) -> None:
    lengths = [
        np.mean(
            [
                plan(
                    scene,
                    k,
                    planner="ShortcutConnect",
                    time_limit=None,
                    max_checks=checks,
                    first_solution=first,
                    start="upright",
                ).length
                for k in (0, 4, 7)
            ]
        )
        for first, checks in ((True, 12_000), (False, 3000), (False, 12_000))
    ]
    assert lengths[0] > lengths[1] > lengths[2]


def test_shortcut_connect_stops_by_itself_and_is_shorter_than_rrtconnect(scene: Scene, goals: Goals) -> None:
    ours, theirs = (
        plan(scene, 0, planner=name, time_limit=None, max_checks=200_000, goals=goals)
        for name in ("ShortcutConnect", "RRTConnect")
    )
    assert ours.checks < 200_000
    assert ours.length <= theirs.length
    assert ours.path is not None
    assert ours.length == pytest.approx(path_length(ours.path))
