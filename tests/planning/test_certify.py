from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.motion.clearance import path_clearance
from greenhouse_gym.planning import CollisionChecker, PlanResult, certify, certify_targets, planning_model
from greenhouse_gym.planning.own_planners import PlannerFailedError
from greenhouse_gym.planning.result import Status
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, Target
from greenhouse_gym.scene.mjcf import compile_scene
from greenhouse_gym.scene.occupancy import FREE, UNKNOWN, OccupancyGrid


@pytest.fixture(scope="module")
def small(scene: Scene) -> Scene:
    """Two tomatoes of a scene and one that is out of reach."""
    tomatoes = (scene.tomatoes[0], scene.tomatoes[4], Tomato(Sphere([3.0, 0.0, 1.0], 0.03), truss=9))
    return scene.model_copy(update={"tomatoes": tomatoes, "targets": ()})


@pytest.fixture(scope="module")
def targets(small: Scene) -> tuple[Target, ...]:
    return certify_targets(small)


def test_every_tomato_is_rated(targets: tuple[Target, ...]) -> None:
    assert [t.tomato for t in targets] == [0, 1, 2]
    assert targets[0].difficulty == "easy"
    assert targets[1].difficulty in ("easy", "medium")
    assert targets[2] == Target(tomato=2, difficulty="unreachable", goals=0)


def test_certificates_hold_goals_checks_clearance_and_the_fraction_in_unknown_space(
    small: Scene, targets: tuple[Target, ...]
) -> None:
    """Made-up scenes do not say what was seen: half of the space before the arm is unknown here."""
    states = np.full((14, 14, 12), FREE, np.uint8)
    states[:, 7:] = UNKNOWN
    half = small.model_copy(update={"occupancy": OccupancyGrid.from_states(states, [-1.4, -1.4, 0.0], 0.2)})
    compiled = compile_scene(small)
    for plain, target in zip(targets, certify_targets(half), strict=True):
        assert plain == target.model_copy(update={"unknown": None})
        if target.witness is None:
            assert (target.clearance, target.unknown) == (None, None)
            continue
        path = np.array(target.witness)
        assert target.goals == certify.GOALS
        assert target.clearance == pytest.approx(path_clearance(compiled, target.tomato, path), abs=1e-4)
        assert (target.checks is None) == (target.difficulty == "easy")
    left, right = (next(t for t in certify_targets(half) if t.tomato == k) for k in (0, 1))
    assert left.unknown != right.unknown


def test_targets_are_spread_over_their_distances(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        certify, "certify_target", lambda compiled, tomato, seed: Target(tomato=tomato, difficulty="easy")
    )
    distance = [np.linalg.norm(tomato.center - [0.0, 0.0, 1.1]) for tomato in scene.tomatoes]
    few = [target.tomato for target in certify_targets(scene, max_targets=3)]
    assert few == sorted(few)
    assert {int(np.argmin(distance)), int(np.argmax(distance))} < set(few)
    assert len(few) == 3
    assert len(certify_targets(scene, max_targets=100)) == len(scene.tomatoes)
    sizes = sorted(tomato.radius for tomato in scene.tomatoes)
    assert sizes[0] < sizes[-1]
    large = [t.tomato for t in certify_targets(scene, min_radius=sizes[-1])]
    assert {scene.tomatoes[k].radius for k in large} == {sizes[-1]}
    assert large == [t.tomato for t in certify_targets(scene, max_targets=len(large), min_radius=sizes[-1])]
    assert len(certify_targets(scene, min_radius=1.0)) == len(scene.tomatoes)  # young rows have targets, too


def test_an_easy_target_is_reached_by_one_straight_motion(targets: tuple[Target, ...]) -> None:
    assert {len(target.witness) for target in targets if target.witness and target.difficulty == "easy"} == {2}


def test_witnesses_are_free_and_end_at_the_target(small: Scene, targets: tuple[Target, ...]) -> None:
    compiled = compile_scene(small)
    for target in targets[:2]:
        path = np.array(target.witness)
        assert np.array_equal(path, path.round(6))
        np.testing.assert_allclose(path[0], get_robot("ur5e").rating_start, atol=1e-6)
        simulator = CollisionChecker(planning_model(compiled, target.tomato, margin=0.0))
        assert simulator.path_is_free(path, 0.002)


def test_same_seed_same_certificates_and_they_survive_the_file(small: Scene, targets: tuple[Target, ...]) -> None:
    assert certify_targets(small) == targets
    certified = small.model_copy(update={"targets": targets})
    assert Scene.model_validate_json(certified.model_dump_json()).targets == targets


def test_the_checks_decide_where_no_straight_motion_is_free(small: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(certify, "_straight", lambda *given: None)
    compiled = compile_scene(small)
    medium = certify.certify_target(compiled, 0)
    assert medium.difficulty == "medium"
    assert medium.checks is not None
    assert 1 < medium.checks <= certify.HARD
    monkeypatch.setattr(certify, "HARD", 1)
    assert certify.certify_target(compiled, 0).difficulty == "hard"
    monkeypatch.setattr(certify, "MAX_CHECKS", 10)
    late = certify.certify_target(compiled, 0)
    assert (late.difficulty, late.checks) == ("hard", None)
    assert late.witness is not None
    monkeypatch.setattr(certify, "LAST_CHECKS", 10)
    none = certify.certify_target(compiled, 0)
    assert (none.difficulty, none.witness, none.goals) == ("unreachable", None, certify.GOALS)


def test_a_planner_that_dies_rates_nothing(small: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Targets were taken for unreachable for which no planner had looked for a path."""
    monkeypatch.setattr(certify, "_straight", lambda *given: None)
    compiled = compile_scene(small)
    expected = certify.certify_target(compiled, 0)
    deaths: list[Status] = ["crashed", "timeout"]
    planned = certify.plan_with

    def dying(*given: Any, **named: Any) -> PlanResult:
        return PlanResult(deaths.pop(), None, "RRTConnect", message="it died") if deaths else planned(*given, **named)

    monkeypatch.setattr(certify, "plan_with", dying)
    assert certify.certify_target(compiled, 0) == expected
    deaths += ["crashed"] * 3
    with pytest.raises(PlannerFailedError, match=r"tomato 0: it cannot be rated\. it died"):
        certify.certify_target(compiled, 0)


@pytest.mark.parametrize(
    ("needed", "expected"),
    [([100, 200], True), ([100], False), ([9000, None], True), ([None, None], False), ([100, 9000], False)],
)
def test_runs_end_when_the_others_cannot_change_the_rating(needed: list[int | None], expected: bool) -> None:
    solved = [
        PlanResult("solved", np.zeros((2, 6)), "RRTConnect", checks=n) if n else PlanResult("no_solution", None, "")
        for n in needed
    ]
    assert certify._decided(solved) == expected
