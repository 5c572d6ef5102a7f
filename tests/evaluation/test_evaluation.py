from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from parallel_helpers import Elsewhere
from still_agent import StillAgent

from greenhouse_gym.agents import PlannerAgent, Problem, RandomAgent, StraightLineAgent
from greenhouse_gym.common.executors import processes
from greenhouse_gym.envs import Randomization
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation import (
    CLEARANCE_RANGE,
    AgentError,
    Evaluation,
    Record,
    compare,
    comparison_table,
    deadline,
    evaluate,
    retrace,
    wilson_interval,
)
from greenhouse_gym.scene import SceneBank
from greenhouse_gym.scene.bank import write_bank

START = "upright"  # from where a straight line often fails
MEASURED = {"planning_time": 0.0, "action_time": 0.0}


@pytest.fixture(scope="module")
def evaluations(bank: SceneBank) -> tuple[Evaluation, ...]:
    agents = [PlannerAgent(), StraightLineAgent(), RandomAgent(), StillAgent()]
    return compare(agents, episodes=12, seed=3, bank=bank, start=START)


def test_all_agents_meet_the_same_episodes(evaluations: tuple[Evaluation, ...]) -> None:
    episodes = [[(r.seed, r.scene, r.target, r.difficulty) for r in e.records] for e in evaluations]
    assert all(e == episodes[0] for e in episodes)
    assert [seed for seed, *_ in episodes[0]] == list(range(3, 15))
    assert len({(scene, target) for _, scene, target, _ in episodes[0]}) > 6


def test_some_episodes_played_again_take_the_same_ways(bank: SceneBank, evaluations: tuple[Evaluation, ...]) -> None:
    """Whatever was played before and in between."""
    for agent, evaluation in zip((RandomAgent(), StraightLineAgent()), (evaluations[2], evaluations[1]), strict=True):
        again = retrace(agent, [9, 4], bank=bank, start=START)
        for trace, record in zip(again, (evaluation.records[6], evaluation.records[1]), strict=True):
            assert replace(trace.record, **MEASURED) == replace(record, **MEASURED)
            assert trace.joints.shape == (record.steps + 1, len(trace.robot.joints))
            assert np.linalg.norm(np.diff(trace.joints, axis=0), axis=-1).sum() == pytest.approx(record.joint_length)


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
        assert 0 < r.roughness < 0.08
        assert r.total_reward > 9.0
    for r in still.records:
        assert r.joint_length < 0.05
        assert r.tip_length < 0.05
        assert r.clearance == CLEARANCE_RANGE


def test_evaluating_again_gives_the_same(bank: SceneBank, evaluations: tuple[Evaluation, ...]) -> None:
    again = evaluate(RandomAgent(), episodes=12, seed=3, bank=bank, start=START)
    assert untimed(again) == untimed(evaluations[2])


@pytest.mark.parametrize("num_envs", [5, 40])
def test_side_by_side_gives_the_same_records(
    bank: SceneBank, evaluations: tuple[Evaluation, ...], num_envs: int
) -> None:
    agents = [PlannerAgent(), StraightLineAgent(), RandomAgent()]
    for agent, alone in zip(agents, evaluations, strict=False):
        assert untimed(evaluate(agent, episodes=12, seed=3, bank=bank, start=START, num_envs=num_envs)) == untimed(
            alone
        )
    problems = [("made-up-0", 3), ("made-up-6", 11), ("made-up-0", 3), ("made-up-1", 2)]
    one, many = (evaluate(RandomAgent(), bank=bank, problems=problems, num_envs=n) for n in (1, 3))
    assert untimed(one) == untimed(many)


def test_episodes_played_elsewhere_give_the_same_records(bank: SceneBank, evaluations: tuple[Evaluation, ...]) -> None:
    elsewhere = Elsewhere()
    there = compare(
        [PlannerAgent(), StraightLineAgent()],
        episodes=12,
        seed=3,
        bank=bank,
        start=START,
        num_envs=2,
        executor=elsewhere,
    )
    assert [untimed(evaluation) for evaluation in there] == [untimed(one) for one in evaluations[:2]]
    assert len(elsewhere.works) == 2 * 6
    problems = [("made-up-0", 3), ("made-up-6", 11), ("made-up-0", 3)]
    here, there_too = (evaluate(RandomAgent(), bank=bank, problems=problems, executor=e) for e in (None, elsewhere))
    assert untimed(here) == untimed(there_too)


def test_processes_play_the_same_episodes(bank: SceneBank, evaluations: tuple[Evaluation, ...]) -> None:
    with processes(1) as executor:
        there = evaluate(RandomAgent(), episodes=12, seed=3, bank=bank, start=START, executor=executor)
    assert untimed(there) == untimed(evaluations[2])


def test_wrong_encoders_change_observations_and_not_what_is_measured(bank: SceneBank) -> None:
    """A planner ignores observations, so it takes the same path; only the observations of the agent are wrong."""
    problems = [("made-up-0", k) for k in range(3)]
    right, wrong = (
        evaluate(PlannerAgent(), bank=bank, problems=problems, randomization=Randomization(joint_offset=offset))
        for offset in (0.0, 0.2)
    )
    measured = [(r.success, r.clearance, r.joint_length, r.tip_length, r.roughness) for r in right.records]
    assert measured == [(r.success, r.clearance, r.joint_length, r.tip_length, r.roughness) for r in wrong.records]
    assert all(r.success and r.clearance > 0 for r in wrong.records)


def test_clearance_is_measured_where_the_base_stands(bank: SceneBank) -> None:
    elsewhere = Randomization(base_position=0.05, base_yaw=0.1)
    records = evaluate(PlannerAgent(), episodes=12, seed=3, bank=bank, randomization=elsewhere).records
    assert any(r.collision for r in records)
    assert all(r.clearance > 0 for r in records if not r.collision)


def test_a_bank_without_a_test_split_says_which_splits_it_has(bank: SceneBank, tmp_path: Path) -> None:
    write_bank(tmp_path, [(bank.scene("made-up-0"), "train")], name="first")
    with pytest.raises(InvalidValueError, match=r"no scene in split 'test'; choices: train"):
        evaluate(StillAgent(), bank=tmp_path)
    assert len(evaluate(StillAgent(), "train", episodes=1, bank=tmp_path).records) == 1


def test_chosen_problems(bank: SceneBank) -> None:
    problems = [("made-up-0", 3), ("made-up-6", 11), ("made-up-0", 3)]
    records = evaluate(StillAgent(), seed=7, bank=bank, problems=problems).records
    assert [(r.scene, r.target) for r in records] == problems
    assert [r.seed for r in records] == [7, 8, 9]


def test_the_table(evaluations: tuple[Evaluation, ...]) -> None:
    lines = comparison_table(evaluations).splitlines()
    assert len(lines) == 6
    assert len({line.count("|") for line in lines}) == 1
    cells = [cell.strip() for cell in lines[2].split("|")]
    assert cells[1:6] == ["RRTConnect", "12", "100.0% [75.8, 100.0]", "100%", "0.0%"]
    assert "nan" not in "".join(lines)


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
    empty = Evaluation("empty", ())
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


def untimed(evaluation: Evaluation) -> list[Record]:
    return [replace(r, **MEASURED) for r in evaluation.records]


class Glancing(StillAgent):
    """Reads every third image of an episode; remembers which images were not zero."""

    name = "glancing"
    env_options = {"observation": "depth"}  # noqa: RUF012

    def __init__(self, flawed: bool = False) -> None:
        super().__init__()
        self.flawed, self.episodes = flawed, list[list[bool]]()

    def reset(self, problem: Problem) -> None:
        super().reset(problem)
        self.episodes.append([])

    def act(self, observation: Any) -> Any:
        self.episodes[-1].append(bool(observation["depth"].any()))
        return super().act(observation)

    @property
    def reads_images(self) -> bool:
        if self.flawed and len(self.episodes) > 1:
            raise RuntimeError("no idea")
        return len(self.episodes[-1]) % 3 == 0


def test_images_that_an_agent_does_not_read_are_zero(bank: SceneBank) -> None:
    agent = Glancing()
    evaluate(agent, episodes=2, bank=bank, step_limit=7, progress=False)
    assert agent.episodes == [[True, False, False, True, False, False, True]] * 2
    flawed = evaluate(Glancing(flawed=True), episodes=2, bank=bank, step_limit=7, progress=False)
    first, second = flawed.records
    assert (first.failure, first.steps) == ("", 7)
    assert "no idea" in second.failure


class Flawed(StillAgent):
    """Acts well at first, and from its second episode's third action on in its own way."""

    name = "flawed"

    def __init__(self, flaw: Any, since: int = 1):
        super().__init__()
        self.flaw, self.since, self.episode, self.steps = flaw, since, -1, 0

    def reset(self, problem: Problem) -> None:
        super().reset(problem)
        self.episode, self.steps = self.episode + 1, 0

    def act(self, observation: Any) -> Any:
        self.steps += 1
        flawed = self.episode >= self.since and self.steps == 3
        return self.flaw() if flawed else super().act(observation)


def no_number() -> Any:
    return np.full(6, np.nan)


def too_few() -> Any:
    return np.zeros(5)


def nothing() -> Any:
    return None


def raises() -> Any:
    raise ZeroDivisionError("of my own")


def hangs() -> Any:
    time.sleep(30)


class FlawedTogether(Flawed):
    """Hangs in its every fourth answer."""

    def act_many(self, observations: Any) -> Any:
        self.steps += 1
        return self.flaw() if self.steps % 4 == 0 else np.zeros((len(observations), 6))


@pytest.mark.parametrize("num_envs", [1, 2])
@pytest.mark.parametrize(
    ("flaw", "message"),
    [
        (no_number, "InvalidValueError: an action must be finite"),
        (too_few, "InvalidValueError: an action must have shape"),
        (nothing, "InvalidValueError: an action must"),
        (raises, "ZeroDivisionError: of my own"),
    ],
)
def test_an_agent_that_fails_on_the_way_loses_the_episode(
    bank: SceneBank, flaw: Any, message: str, num_envs: int
) -> None:
    evaluation = evaluate(Flawed(flaw), episodes=5, bank=bank, num_envs=num_envs)
    assert len(evaluation.records) == 5
    failed = [r for r in evaluation.records if r.failure]
    assert evaluation.failures == len(failed) == 5 - num_envs, "each player's first episode is played to its end"
    assert all(message in r.failure and not r.success and not r.collision for r in failed)
    assert failed[0].steps == 2
    assert f"flawed: {len(failed)} episodes ended without a valid action" in comparison_table([evaluation])


@pytest.fixture
def hangs_are_left_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not wait for a thread that sleeps: it ends only when it wakes up."""
    monkeypatch.setattr(deadline, "_SECONDS_TO_END", 0.05)


@pytest.mark.usefixtures("hangs_are_left_soon")
@pytest.mark.parametrize(("num_envs", "failed"), [(1, [1, 3, 5, 7, 8, 9, 10]), (2, [2, 3, 6, 7, 9, 10])])
def test_an_agent_that_hangs_loses_the_episode_and_a_copy_plays_on(
    bank: SceneBank, num_envs: int, failed: list[int]
) -> None:
    evaluation = evaluate(Flawed(hangs), episodes=11, bank=bank, timeout=0.5, num_envs=num_envs)
    assert [i for i, r in enumerate(evaluation.records) if r.failure] == failed, "three copies and no more"
    assert {r.failure for r in evaluation.records} == {"", "TimeoutError: timed out after 0.5 s"}


@pytest.mark.usefixtures("hangs_are_left_soon")
@pytest.mark.parametrize("num_envs", [1, 2])
def test_one_that_plays_all_episodes_together_is_replaced_as_well(bank: SceneBank, num_envs: int) -> None:
    agent = FlawedTogether(hangs)
    evaluation = evaluate(agent, episodes=6, bank=bank, timeout=0.5, num_envs=num_envs)
    assert [r.steps for r in evaluation.records] == [3] * min(6, 4 * num_envs) + [0] * (6 - min(6, 4 * num_envs))
    assert agent.steps == 4, "a copy took its place"


def test_an_agent_that_never_acts_is_an_error_and_the_comparison_goes_on(bank: SceneBank) -> None:
    never = Flawed(raises, since=0)
    never.steps = 2
    never.reset = lambda problem: setattr(never, "steps", 2)  # type: ignore[method-assign]
    never.episode = 0
    with pytest.raises(AgentError, match=r"'flawed' failed before its first action \(seed 4\): ZeroDivisionError"):
        evaluate(never, episodes=2, seed=4, bank=bank)
    error, still = compare([never, StillAgent()], episodes=1, bank=bank)
    assert (error.records, len(still.records)) == ((), 1)
    assert "flawed: agent 'flawed' failed" in comparison_table([error, still])


class Broken(StillAgent):
    name = "broken"

    def act(self, observation: Any) -> Any:
        raise ZeroDivisionError


def test_agents_that_fail_elsewhere_are_told_as_here(bank: SceneBank) -> None:
    broken = Broken()
    with pytest.raises(AgentError) as here:
        evaluate(broken, episodes=4, bank=bank)
    with pytest.raises(AgentError) as there:
        evaluate(broken, episodes=4, bank=bank, executor=Elsewhere())
    assert str(here.value) == str(there.value)
    on_the_way = [evaluate(Flawed(raises, since=0), episodes=4, bank=bank, executor=e) for e in (None, Elsewhere())]
    assert untimed(on_the_way[0]) == untimed(on_the_way[1])


def test_an_agent_that_cannot_travel_is_named(bank: SceneBank) -> None:
    agent = RandomAgent()
    agent.memory = lambda: None  # type: ignore[attr-defined]
    with pytest.raises(
        AgentError, match="agent 'random' cannot be sent to another process: with its options it cannot be p"
    ):
        evaluate(agent, episodes=4, bank=bank, executor=Elsewhere())


def test_what_is_no_agent_is_named(bank: SceneBank) -> None:
    with pytest.raises(InvalidValueError, match=r"StillAgent is a class: .* such as StillAgent\(\)"):
        evaluate(StillAgent, bank=bank)  # type: ignore[arg-type]

    class Mute:
        name, env_options = "mute", {}

        def reset(self, problem: Problem) -> None: ...

    with pytest.raises(InvalidValueError, match="'mute' is no agent: its 'act' is missing"):
        evaluate(Mute(), bank=bank)  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="num_envs"):
        evaluate(StillAgent(), bank=bank, num_envs=0)


def test_agents_that_cannot_be_copied_play_alone(bank: SceneBank) -> None:
    class Unique(StillAgent):
        name = "unique"

        def __deepcopy__(self, memo: Any) -> Any:
            raise TypeError("there is only one")

    assert len(evaluate(Unique(), episodes=1, bank=bank).records) == 1
    with pytest.raises(AgentError, match=r"'unique' cannot be copied .* act_many"):
        evaluate(Unique(), episodes=2, bank=bank, num_envs=2)


def test_agents_without_memory_act_for_all_at_once(bank: SceneBank) -> None:
    class Many(StillAgent):
        name = "many"

        def __init__(self) -> None:
            super().__init__()
            self.asked: list[int] = []

        def act_many(self, observations: Any) -> Any:
            self.asked.append(len(observations))
            return np.zeros((len(observations), 6))

    agent = Many()
    together = evaluate(agent, episodes=3, bank=bank, num_envs=2)
    assert max(agent.asked) == 2
    assert untimed(together) == untimed(replace(evaluate(StillAgent(), episodes=3, bank=bank), agent="many"))
