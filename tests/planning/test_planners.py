from __future__ import annotations

import math

import numpy as np
import pytest

from greenhouse_gym.errors import GreenhouseError, InvalidValueError, UnknownNameError
from greenhouse_gym.planning import PAPER_PLANNERS, PLANNERS, goal_configurations, plan
from greenhouse_gym.planning.parameters import Parameter
from greenhouse_gym.scene import Scene

OF_OMPL = {name for name, info in PLANNERS.items() if info.solve is None}
UNBOUND = {"BiTRRT", "CForest", "pRRT", "pSBL"}
OMPL_1 = len(OF_OMPL) > 20
needs_ompl_1 = pytest.mark.skipif(not OMPL_1, reason="OMPL 2 binds fewer planners")


def test_every_planner_is_described() -> None:
    assert list(PLANNERS) == sorted(PLANNERS)
    for name, info in PLANNERS.items():
        assert info.name == name
        assert info.description not in ("", "not described")


@needs_ompl_1
def test_33_of_the_wheel_and_all_25_of_the_paper() -> None:
    assert len(OF_OMPL - UNBOUND) == 33
    assert len(set(PAPER_PLANNERS)) == 25
    assert set(PAPER_PLANNERS) < set(PLANNERS)


@needs_ompl_1
def test_parameters_are_those_of_ompl() -> None:
    assert PLANNERS["RRTConnect"].parameters == {
        "intermediate_states": Parameter(False),
        "range": Parameter(0.0, 0.0, 10_000.0),
    }
    assert PLANNERS["SPARStwo"].parameters["max_failures"] == Parameter(5000, 100, 5000)  # OMPL's range ends at 3000
    assert PLANNERS["LazyPRM"].parameters["max_nearest_neighbors"] == Parameter(0, 0, 1000)
    assert PLANNERS["TRRT"].parameters["cost_threshold"] == Parameter(math.inf)
    assert PLANNERS["pSBL"].parameters["thread_count"] == Parameter(2, 1, 64)
    assert PLANNERS["PRMstar"].parameters == {}


@needs_ompl_1
@pytest.mark.parametrize("name", sorted(OF_OMPL))
def test_planners_have_parameters_that_allow_their_settings(name: str) -> None:
    info = PLANNERS[name]
    defaults = {key: parameter.default for key, parameter in info.parameters.items()}
    assert info.with_settings(info.settings) == info.settings
    assert info.with_settings(defaults) == defaults  # type: ignore[arg-type]


@needs_ompl_1
def test_settings_are_checked() -> None:
    info = PLANNERS["RRTConnect"]
    assert info.with_settings({}) == {"range": 0.8}
    assert info.with_settings({"range": 0.3}) == {"range": 0.3}
    assert info.with_settings({"intermediate_states": True}) == {"range": 0.8, "intermediate_states": True}
    with pytest.raises(UnknownNameError, match=r"setting of RRTConnect 'rang'.*Did you mean 'range'"):
        info.with_settings({"rang": 0.3})
    for wrong in (-1.0, math.nan, math.inf, "0.3", True):
        with pytest.raises(InvalidValueError, match="RRTConnect: range must be a finite number from 0 to 10000, got"):
            info.with_settings({"range": wrong})  # type: ignore[dict-item]
    with pytest.raises(InvalidValueError, match="goal_bias must be a finite number from 0 to 1, got"):
        PLANNERS["RRT"].with_settings({"goal_bias": 1.5})
    with pytest.raises(InvalidValueError, match="heuristics must be True or False, got 1"):
        PLANNERS["FMT"].with_settings({"heuristics": 1})
    for number in (10.5, -1, True):
        with pytest.raises(InvalidValueError, match="num_samples must be a whole number from 10 to"):
            PLANNERS["FMT"].with_settings({"num_samples": number})


def test_unknown_planners_list_the_choices() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'RRTConnect'"):
        PLANNERS["RRTconnect"]
    assert "RRTconnect" not in PLANNERS
    assert issubclass(UnknownNameError, GreenhouseError)


@pytest.mark.parametrize("name", sorted(PLANNERS))
def test_every_planner_answers(scene: Scene, name: str) -> None:
    """Whatever the planner does, there is a status; what counts as a path was proven free by the caller."""
    goals = goal_configurations(scene, 0, count=10)
    result = plan(scene, 0, planner=name, time_limit=0.2, goals=goals, seed=1)
    assert result.status in ("solved", "approximate", "no_solution", "invalid")
    assert (result.path is not None) == (result.status == "solved")
    if result.path is not None:
        straight = np.linalg.norm(goals.configurations - result.path[0], axis=-1).min()
        assert len(result.costs) > 0
        assert (result.costs[:, 1] >= straight - 1e-4).all()


@pytest.mark.parametrize("name", sorted(name for name, info in PLANNERS.items() if info.reproducible))
def test_same_seed_and_number_of_checks_same_path(scene: Scene, name: str) -> None:
    goals = goal_configurations(scene, 0, count=10)
    runs = []
    for seed in (4, 9, 4):  # another problem in between
        runs.append(plan(scene, 0, planner=name, time_limit=30.0, max_checks=1500, goals=goals, seed=seed))
    first, _, again = runs
    assert first.status == again.status
    assert first.checks == again.checks
    assert (first.path is None) == (again.path is None)
    if first.path is not None and again.path is not None:
        assert np.array_equal(first.path, again.path)
        assert np.array_equal(first.raw_path, again.raw_path)  # type: ignore[arg-type]
