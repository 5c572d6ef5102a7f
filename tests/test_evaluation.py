from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from greenhouse_gym.agents import PlannerAgent, RandomAgent, StillAgent, StraightLineAgent
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation import (
    CLEARANCE_RANGE,
    Evaluation,
    Record,
    compare,
    comparison_table,
    evaluate,
    wilson_interval,
)
from greenhouse_gym.scene import SceneBank


@pytest.fixture(scope="module")
def evaluations(bank: SceneBank) -> tuple[Evaluation, ...]:
    return compare([PlannerAgent(), StraightLineAgent(), RandomAgent(), StillAgent()], episodes=12, seed=3, bank=bank)


def test_all_agents_meet_the_same_episodes(evaluations: tuple[Evaluation, ...]) -> None:
    episodes = [[(r.seed, r.scene, r.target, r.difficulty) for r in e.records] for e in evaluations]
    assert all(e == episodes[0] for e in episodes)
    assert [seed for seed, *_ in episodes[0]] == list(range(3, 15))
    assert len({(scene, target) for _, scene, target, _ in episodes[0]}) > 6


def test_the_planner_reaches_and_the_others_are_told_apart(evaluations: tuple[Evaluation, ...]) -> None:
    planner, line, random, still = evaluations
    assert planner.success_rate == 1.0
    assert planner.collision_rate == 0.0
    assert {r.status for r in planner.records} == {"solved"}
    assert line.success_rate < 0.8
    assert random.success_rate < 0.2
    assert still.success_rate == 0.0
    assert all(r.steps == 200 for r in still.records)
    for evaluation in evaluations:
        for r in evaluation.records:
            assert not (r.success and r.collision)
            assert bool(r.contact) == r.collision
            assert r.success <= (r.distance < 0.02)
            if r.collision and not {"floor", "cart"} & set(r.contact):
                assert r.clearance < CLEARANCE_RANGE


def test_the_numbers_of_an_episode(evaluations: tuple[Evaluation, ...]) -> None:
    planner, _, _, still = evaluations
    for r in planner.records:
        assert 0.003 < r.clearance <= CLEARANCE_RANGE
        assert r.joint_length > 1.0
        assert 0.3 < r.tip_length < r.joint_length * 1.5
        assert r.planning_time > 0.001
        assert 0 < r.jerkiness < 0.08
        assert r.total_reward > 9.0
    for r in still.records:
        assert r.joint_length < 0.05
        assert r.tip_length < 0.05
        assert r.clearance == CLEARANCE_RANGE


def test_evaluating_again_gives_the_same(bank: SceneBank, evaluations: tuple[Evaluation, ...]) -> None:
    again = evaluate(RandomAgent(), episodes=12, seed=3, bank=bank)
    measured = {"planning_time": 0.0, "action_time": 0.0}
    assert [replace(r, **measured) for r in again.records] == [replace(r, **measured) for r in evaluations[2].records]


def test_chosen_problems(bank: SceneBank) -> None:
    problems = [("made-up-0", 3), ("made-up-6", 11), ("made-up-0", 3)]
    records = evaluate(StillAgent(), seed=7, bank=bank, problems=problems).records
    assert [(r.scene, r.target) for r in records] == problems
    assert [r.seed for r in records] == [7, 8, 9]


def test_the_table(evaluations: tuple[Evaluation, ...]) -> None:
    lines = comparison_table(evaluations).splitlines()
    assert len(lines) == 6
    assert len({line.count("|") for line in lines}) == 1
    assert lines[2].startswith("| RRTConnect | 12 | 100.0% [75.8%, 100.0%] | 100.0% | 0.0% |")
    assert "nan" in lines[5]


def test_wilson() -> None:
    # the textbook's values for 8 of 10
    low, high = wilson_interval(8, 10)
    assert (round(low, 3), round(high, 3)) == (0.490, 0.943)
    assert wilson_interval(0, 0) == (0.0, 1.0)
    assert wilson_interval(0, 50)[0] == 0.0
    assert wilson_interval(50, 50)[1] == pytest.approx(1.0)
    for n in (5, 100):
        bounds = np.array([wilson_interval(k, n) for k in range(n + 1)])
        assert (np.diff(bounds, axis=0) > 0).all()


def test_empty_and_partial() -> None:
    empty = Evaluation("nobody", ())
    assert math.isnan(empty.success_rate)
    assert math.isnan(empty.median("steps"))
    record = Record(0, "s", 1, "hard", True, False, (), 10, 0.1, 0.0, 1.0, 1.0, 0.05, 0.0, 10.0, 0.01)
    both = Evaluation("x", (record, replace(record, difficulty="easy", success=False, steps=200)))
    assert both.of("hard").success_rate == 1.0
    assert both.of("easy").success_rate == 0.0
    assert both.median("steps") == 105
    assert both.median("steps", solved_only=True) == 10


def test_bad_requests(bank: SceneBank) -> None:
    with pytest.raises(InvalidValueError, match="episodes"):
        evaluate(StillAgent(), episodes=0, bank=bank)

    class Picky(StillAgent):
        name = "picky"
        env_options = {"reward": "dense"}  # noqa: RUF012

    with pytest.raises(InvalidValueError, match="'picky' needs reward='dense', got 'sparse'"):
        evaluate(Picky(), episodes=1, bank=bank, reward="sparse")
