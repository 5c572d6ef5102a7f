from __future__ import annotations

import math

import numpy as np
import pytest

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.planning import (
    PLANNERS,
    CollisionChecker,
    PlanResult,
    goal_configurations,
    plan,
    planner_run,
    planning_model,
)
from greenhouse_gym.planning.worker import PlannerAnswer
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import compile_scene

START = get_robot("ur5e").start


@pytest.mark.parametrize("planner", ["RRTConnect", "KPIECE1", "BITstar", "RRTstar", "PRM", "AITstar", "BiTRRT", "pSBL"])
def test_planned_paths_are_free_in_the_simulator(scene: Scene, planner: str) -> None:
    if planner not in PLANNERS:
        pytest.skip(f"this OMPL has no {planner}")
    lazy = planner == "AITstar"  # checks so little that only the time limit would end it
    result = plan(scene, 0, planner=planner, time_limit=20.0, max_checks=30_000, first_solution=lazy)
    assert result.status == "solved"
    assert result.path is not None
    assert np.array_equal(result.path[0], START)
    goals = goal_configurations(scene, 0).configurations
    assert (result.path[-1] == goals).all(-1).any()
    simulator = CollisionChecker(planning_model(compile_scene(scene), 0, margin=0.0))
    for a, b in zip(result.path[:-1], result.path[1:], strict=True):
        assert all(map(simulator.is_free, a + np.linspace(0, 1, 800)[:, None] * (b - a)))
    assert result.length <= result.raw_length + 1e-9
    assert result.checks > 0
    assert result.goals is not None
    assert result.tree_size > 0 or planner == "AITstar"
    assert result.raw_path is not None
    assert np.array_equal(result.raw_path[0], START)
    assert result.costs[-1, 1] == pytest.approx(result.raw_length, rel=2e-5)
    assert 0.0 < result.clearance <= 0.1


def test_same_seed_and_checks_same_path(scene: Scene) -> None:
    first, again, other = (plan(scene, 7, max_checks=50_000, time_limit=60.0, seed=s) for s in (5, 5, 6))
    assert first.path is not None
    assert other.path is not None
    assert np.array_equal(first.path, again.path)
    assert first.checks == again.checks
    assert not np.array_equal(first.path, other.path)


def test_optimizing_planners_report_their_cost_over_time(scene: Scene) -> None:
    if "RRTsharp" not in PLANNERS:
        pytest.skip("OMPL 2 does not tell Python")
    result = plan(scene, 0, planner="BITstar", time_limit=1.0, seed=3, start="upright")
    seconds, costs = result.costs.T
    assert len(costs) > 1
    assert (np.diff(seconds) > 0).all()
    assert (np.diff(costs) < 0).all()
    assert 0 < seconds[0] < seconds[-1] < result.planning_time + 0.1


@pytest.mark.parametrize("planner", ["RRTstar", "BITstar", "SPARStwo"])
def test_the_first_solution_ends_an_optimizing_search(scene: Scene, planner: str) -> None:
    if "RRTsharp" not in PLANNERS:
        pytest.skip("OMPL 2 does not tell Python")
    assert PLANNERS[planner].optimizing
    result, again = (
        plan(scene, 0, planner=planner, time_limit=20.0, max_checks=100_000, first_solution=True) for _ in range(2)
    )
    assert result.status == "solved"
    assert len(result.costs) == 1
    assert result.checks < 100_000
    if PLANNERS[planner].reproducible:
        assert result.checks == again.checks
        assert np.array_equal(result.path, again.path)


def test_settings_change_what_a_planner_does(scene: Scene) -> None:
    usual = plan(scene, 7, max_checks=50_000, time_limit=60.0)
    other = plan(scene, 7, max_checks=50_000, time_limit=60.0, settings={"range": 0.1})
    assert usual.status == other.status == "solved"
    assert other.raw_path is not None
    assert np.linalg.norm(np.diff(other.raw_path, axis=0), axis=-1).max() < 0.1 + 1e-6
    with pytest.raises(UnknownNameError, match="setting of RRTConnect 'goal_bias'"):
        plan(scene, 7, settings={"goal_bias": 0.1})


@pytest.mark.parametrize(
    ("planner", "settings"), [("BITstar", {"samples_per_batch": 200}), ("BiTRRT", {"range": 1, "init_temperature": 50})]
)
def test_settings_of_any_type_reach_the_planner(scene: Scene, planner: str, settings: dict[str, float]) -> None:
    if planner not in PLANNERS:
        pytest.skip(f"this OMPL has no {planner}")
    assert plan(scene, 0, planner=planner, max_checks=30_000, settings=settings).status == "solved"


def test_what_the_arm_is_checked_against_can_be_chosen(scene: Scene) -> None:
    in_the_cart = [0, 1.0, 0, 0, 0, 0]
    assert plan(scene, 0, start=in_the_cart).status == "start_in_collision"
    result = plan(scene, 0, start=in_the_cart, pairs=("tomatoes", "stems", "clutter"))
    assert result.status == "solved"
    with pytest.raises(UnknownNameError, match=r"collision pair 'leaves'.*stems"):
        plan(scene, 0, pairs=("leaves",))


def test_two_thousand_obstacles(scene: Scene) -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform([0.75, -1.5, 0.2], [1.2, 1.5, 2.0], (2000, 3))
    crowded = scene.model_copy(update={"clutter": tuple(Sphere(place, 0.01) for place in places)})
    result = plan(crowded, 0, max_checks=20_000, time_limit=60.0)
    assert result.status == "solved"


def test_checks_are_a_budget(scene: Scene) -> None:
    result = plan(scene, 7, max_checks=50, time_limit=60.0)
    assert result.status in ("no_solution", "approximate")
    assert result.path is None
    assert math.isnan(result.length)
    assert 50 <= result.checks < 600  # the motion under way is finished
    assert result.planning_time < 5.0


@pytest.mark.parametrize("time_limit", [None, 1e9, 1e300])
def test_checks_alone_may_end_a_search(scene: Scene, time_limit: float | None) -> None:
    first, again = (plan(scene, 0, time_limit=limit, max_checks=30_000) for limit in (time_limit, 60.0))
    assert first.status == again.status == "solved"
    assert np.array_equal(first.path, again.path)  # type: ignore[arg-type]


def test_goals_may_be_given(scene: Scene) -> None:
    goals = goal_configurations(scene, 2, count=5)
    for given in (goals, goals.configurations, goals.configurations[:1].tolist()):
        result = plan(scene, 2, goals=given)
        assert result.status == "solved"
        assert result.path is not None
        assert (result.path[-1] == goals.configurations).all(-1).any()
        assert result.goals is None


def test_start_elsewhere(scene: Scene) -> None:
    start = get_robot("ur5e").starts["upright"] + [0.5, 0.2, 0.3, -0.4, 0.5, 0.0]
    result = plan(scene, 3, start=start)
    assert result.path is not None
    assert np.array_equal(result.path[0], start)
    folded = plan(scene, 3, start="folded")
    assert folded.path is not None
    assert np.array_equal(folded.path[0], get_robot("ur5e").starts["folded"])
    touching = goal_configurations(scene, 2, count=1).configurations[0]  # the cup may touch the target, no other
    assert plan(scene, 3, start=touching).message == "at the start: tomato_2 with cup"


def test_a_colliding_start_is_a_result(scene: Scene) -> None:
    result = plan(scene, 0, start=[0, 1.0, 0, 0, 0, 0])
    assert result.status == "start_in_collision"
    assert "cart" in result.message


def test_nothing_to_reach_is_a_result(scene: Scene) -> None:
    far = scene.model_copy(update={"tomatoes": (Tomato(Sphere([3.0, 0.0, 1.0], 0.03), truss=0),)})
    result = plan(far, 0)
    assert result.status == "no_goal"
    assert result.goals is not None
    assert result.goals.converged == 0
    folded = [0, 1.0, 0, 0, 0, 0]  # in the cart
    assert plan(scene, 0, goals=[folded]).status == "no_goal"


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"target": 12}, "tomatoes 0 to 11"),
        ({"time_limit": 0.0}, "time_limit"),
        ({"time_limit": -1.0}, "time_limit"),
        ({"time_limit": math.inf}, "time_limit"),
        ({"time_limit": math.nan}, "time_limit"),
        ({"max_checks": 0}, "max_checks"),
        ({"time_limit": None}, "time_limit is None: give max_checks"),
        ({"seed": -1}, "seed must be a whole number from 0 on, got -1"),
        ({"goals": 0}, "count"),
        ({"start": [0, 0, 0, 4, 0, 0]}, "wrist_1.*4.00000"),
        ({"start": [math.nan] * 6}, "shoulder_pan"),
        ({"start": [0.0]}, "6 joint angles"),
        ({"goals": [[0, 0, 9, 0, 0, 0]]}, "elbow"),
        ({"goals": [0.0, 1.0]}, "6 joint angles"),
        *(({"target": wrong}, "target") for wrong in (None, "0", 1.5, True, -1, [0], math.nan)),
        *(({"time_limit": wrong}, "time_limit") for wrong in ("1", True, [1.0], 1j, -math.inf)),
        *(({"max_checks": wrong}, "max_checks") for wrong in ("a", 1.5, True, math.nan, [1], -(2**70))),
        *(({"seed": wrong}, "seed") for wrong in ("1", None, 1.0, True)),
        *(({"goals": wrong}, "goals") for wrong in (None, "a", True, 1.5, -3, ["a"], [[1.0], [1.0, 2.0]])),
        *(({"start": wrong}, "start") for wrong in (3, ["a"] * 6, [None] * 6, {})),
        *(({"margin": wrong}, "margin") for wrong in (None, "a", True, math.nan, math.inf, -0.1)),
        *(({"unknown": wrong}, "unknown") for wrong in (None, True, -1, math.nan, [0.1])),
        *(({"pairs": wrong}, "pairs") for wrong in (None, 3, "stems")),
        *(({"settings": wrong}, "settings") for wrong in ("range", 3, [("range", 1.0)])),
    ],
)
def test_bad_values_are_named(scene: Scene, wrong: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        plan(scene, **{"target": 0, **wrong})  # type: ignore[arg-type]


def test_unknown_names_list_the_choices(scene: Scene) -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'RRTConnect'"):
        plan(scene, 0, planner="RRTconnect")
    with pytest.raises(UnknownNameError, match="ur5e"):
        plan(scene, 0, robot="ur6")
    with pytest.raises(InvalidValueError, match="scene must be a Scene, got 'mini'"):
        plan("mini", 0)  # type: ignore[arg-type]


def test_numbers_of_numpy_are_numbers(scene: Scene) -> None:
    numbers = {"target": np.int64(1), "time_limit": np.float32(9), "max_checks": np.int32(9999), "goals": np.int16(3)}
    assert plan(scene, **numbers, seed=np.int64(3), margin=np.float32(0)).status == "solved"  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("flaw", "message"),
    [("start", "starts at"), ("end", "none of the goals"), ("limits", "joint limits"), ("nan", "not numbers"),
     ("cut", "not free")],
)  # fmt: skip
def test_every_path_of_the_worker_is_verified(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, flaw: str, message: str
) -> None:
    good = plan(scene, 7)
    assert good.path is not None
    path = good.path.copy()
    if flaw == "cut":
        low = START + [0, 1.5, 0, 0, 0, 0]  # through the cart
        path = np.array([path[0], low.clip(-3, 1.5), path[-1]])
    elif flaw == "start":
        path[0] += 1e-6
    elif flaw == "end":
        path[-1] += 1e-6
    elif flaw == "limits":
        path = np.insert(path, 1, 5.0, axis=0)
    else:
        path = np.insert(path, 1, np.nan, axis=0)
    answer = PlannerAnswer("solved", path, path, 0.1, 0.0, 10, 5, np.empty((0, 2)))
    monkeypatch.setattr(planner_run.shared_worker(), "call", lambda *_: answer)
    result: PlanResult = plan(scene, 7, planner="RRT")
    assert result.status == "invalid"
    assert result.path is None
    assert message in result.message


def test_a_budget_of_checks_limits_the_time_of_planners_that_hardly_check() -> None:
    assert planner_run.search_seconds(None, 1_000) <= 10.0
    assert planner_run.search_seconds(None, 1_000_000) >= 100.0
