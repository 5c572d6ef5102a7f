"""Agents that try to end a comparison, or to bend its rules."""

from __future__ import annotations

import itertools
import math
import os
import re
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from threading import active_count
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from still_agent import StillAgent
from typer.testing import CliRunner

from greenhouse_gym.agents import Problem, WaypointAgent
from greenhouse_gym.cli.main import app
from greenhouse_gym.common import isolation
from greenhouse_gym.common.executors import processes
from greenhouse_gym.common.files import exclusive
from greenhouse_gym.errors import FileWriteError, InvalidValueError
from greenhouse_gym.evaluation import (
    AgentError,
    Evaluation,
    compare,
    comparison_table,
    evaluate,
    leaderboard,
    retrace,
    rollouts,
    runner,
)
from greenhouse_gym.evaluation.entry import columns_of
from greenhouse_gym.evaluation.journal import RecordJournal
from greenhouse_gym.evaluation.leaderboard import CURRENT, Entry, read_entry, submit
from greenhouse_gym.evaluation.records import Record, pairing, pairings
from greenhouse_gym.reporting.comparison_figures import pairs_table
from greenhouse_gym.scene import SceneBank

SHORT = replace(CURRENT, bank="mini", split="validation", episodes=2)


class Quit(BaseException):
    pass


class UnprintableError(Exception):
    def __str__(self) -> str:
        raise ZeroDivisionError

    __repr__ = __str__


class QuitsWhenPrintedError(Exception):
    def __str__(self) -> str:
        sys.exit(4)


class OddAnswer:
    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        sys.exit("in the middle of NumPy")


def failing(error: BaseException) -> Callable[[], Any]:
    def fail() -> Any:
        raise error

    return fail


FAULTS: dict[str, tuple[Callable[[], Any], str]] = {
    "quits": (lambda: sys.exit(3), "SystemExit: 3"),
    "quits without a word": (sys.exit, "SystemExit"),
    "raises a BaseException": (failing(Quit("enough")), "Quit: enough"),
    "ends a generator": (failing(GeneratorExit()), "GeneratorExit"),
    "raises what cannot be printed": (failing(UnprintableError()), "UnprintableError: its message cannot be printed"),
    "raises what quits when printed": (failing(QuitsWhenPrintedError()), "QuitsWhenPrintedError: its message cannot"),
    "says half a letter": (failing(ValueError("\ud800")), "ValueError: ?"),
    "says too much": (failing(ValueError("x" * 10**6)), "ValueError: xxx"),
    "answers with a trap": (OddAnswer, "SystemExit: in the middle of NumPy"),
}


class Hostile(StillAgent):
    """Fails in its first or third action, or while it is reset; its status cannot be read."""

    name = "hostile"

    def __init__(self, fault: str, at: int):
        super().__init__()
        self.fault, self.at, self.steps = fault, at, 0

    def reset(self, problem: Problem) -> None:
        super().reset(problem)
        self.steps = 0
        if self.at == 0:
            FAULTS[self.fault][0]()

    def act(self, observation: Any) -> Any:
        self.steps += 1
        return FAULTS[self.fault][0]() if self.steps == self.at else super().act(observation)

    @property
    def status(self) -> str:
        sys.exit("no status")


IN_THREADS = [(fault, 60.0) for fault in ("quits", "raises what quits when printed", "answers with a trap")]


@pytest.mark.parametrize(("fault", "timeout"), [*((fault, None) for fault in FAULTS), *IN_THREADS])
def test_no_agent_ends_a_comparison(bank: SceneBank, fault: str, timeout: float | None, tmp_path: Path) -> None:
    agents = [Hostile(fault, 3), Hostile(fault, 1), StillAgent()]
    if fault != "answers with a trap":
        agents.insert(0, Hostile(fault, 0))
    *early, still = compare(agents, episodes=2, bank=bank, timeout=timeout, step_limit=4)
    late = early.pop(-2)
    assert [record.failure for record in still.records] == ["", ""]
    assert all(not e.records and FAULTS[fault][1] in e.error for e in early)
    assert len(late.records) == 2
    assert all(FAULTS[fault][1] in r.failure and r.steps == 2 and len(r.failure) <= 1000 for r in late.records)
    assert FAULTS[fault][1][:9] in comparison_table([late, *early, still])
    journal = RecordJournal(tmp_path / "records.jsonl", {})
    journal.add(0, late.records[0])
    assert RecordJournal(tmp_path / "records.jsonl", {}).records == {0: late.records[0]}


class Forking(StillAgent):
    """Forks in its second action."""

    name = "forking"
    steps = 0

    def act(self, observation: Any) -> Any:
        self.steps += 1
        if self.steps == 2:
            os.fork()
        return super().act(observation)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork")
@pytest.mark.parametrize("timeout", [None, 60.0])
def test_only_one_process_goes_on_if_an_agent_forks(bank: SceneBank, timeout: float | None) -> None:
    process, (ours, theirs) = os.getpid(), os.pipe()
    evaluation = evaluate(Forking(), episodes=2, bank=bank, timeout=timeout, step_limit=4)
    os.write(theirs, b"x")
    if os.getpid() != process:
        os._exit(0)
    assert [record.failure for record in evaluation.records] == ["", ""]
    assert os.wait()[1]  # the copy has ended
    assert os.read(ours, 2) == b"x"
    os.close(ours)
    os.close(theirs)


class Greedy(StillAgent):
    """Takes all memory in its second episode, at once or bit by bit, and keeps it."""

    name = "greedy"

    def __init__(self, size: int):
        super().__init__()
        self.size, self.kept, self.seed = size, list[np.ndarray](), 0

    def reset(self, problem: Problem) -> None:
        super().reset(problem)
        self.seed = problem.seed

    def act(self, observation: Any) -> Any:
        while self.seed == 1 and sum(map(len, self.kept)) < 2**31:
            self.kept.append(np.ones(self.size, np.uint8))
        return super().act(observation)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="only Linux limits memory")
@pytest.mark.parametrize(("size", "timeout"), [(2**31, None), (2**20, 60.0)], ids=["at once", "bit by bit"])
def test_an_agent_gets_no_more_memory_than_there_is(
    bank: SceneBank, size: int, timeout: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    import resource

    monkeypatch.setattr(isolation, "available_memory", lambda: 2**27)
    before = resource.getrlimit(resource.RLIMIT_DATA)
    greedy, still = compare([Greedy(size), StillAgent()], episodes=2, bank=bank, timeout=timeout, step_limit=4)
    assert [record.failure[:13] for record in greedy.records] == ["", "MemoryError: "]
    assert [record.failure for record in still.records] == ["", ""]
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


def test_a_call_that_timed_out_ends(bank: SceneBank) -> None:
    class Endless(StillAgent):
        def act(self, observation: Any) -> Any:
            while True:
                pass

    threads = active_count()
    with pytest.raises(AgentError, match=r"timed out after 0\.1 s"):
        evaluate(Endless(), episodes=1, bank=bank, timeout=0.1)
    assert active_count() == threads


class OwnPart:
    """An observation or a kind of action of an agent's own that fails."""

    def __init__(self, fail: Callable[[], Any], size: int):
        self.fail, self.space = fail, spaces.Box(-1, 1, (size,), np.float32)

    def __call__(self, state: Any, *_: Any) -> Any:
        return self.fail()


def endless() -> None:
    while True:
        pass


PARTS = {
    "quits": (lambda: sys.exit(3), "SystemExit: 3"),
    "fails": (lambda: 1 // 0, "ZeroDivisionError"),
    "answers with a trap": (OddAnswer, "SystemExit"),
    "never ends": (endless, r"timed out after 0\.2 s"),
}


@pytest.mark.parametrize("part", ["observation", "action"])
@pytest.mark.parametrize("fault", PARTS)
def test_an_agents_own_observation_or_action_ends_no_comparison(bank: SceneBank, part: str, fault: str) -> None:
    fail, problem = PARTS[fault]
    failing = StillAgent()
    failing.env_options = {part: OwnPart(fail, 1 if part == "observation" else 6)}
    lost, still = compare([failing, StillAgent()], episodes=1, bank=bank, step_limit=2, timeout=0.2)
    assert re.search(f"its own observation or action failed: .*{problem}", lost.error)
    assert [record.failure for record in still.records] == [""]


@pytest.mark.parametrize(
    "options", [{"observation": "none such"}, {"action": 3}, {"observation": ""}, {"action": len}], ids=str
)
def test_options_of_an_agent_that_cannot_be_used_end_no_comparison(bank: SceneBank, options: dict[str, Any]) -> None:
    wanting = StillAgent()
    wanting.env_options = options
    lost, still = compare([wanting, StillAgent()], episodes=1, bank=bank, step_limit=2)
    assert f"its env_options ({next(iter(options))}) cannot be used: " in lost.error
    assert len(still.records) == 1
    with pytest.raises(InvalidValueError, match=r"^step_limit"):  # of the caller
        compare([wanting, StillAgent()], episodes=1, bank=bank, step_limit=-2)


def test_work_in_an_agents_own_observation_counts_as_its_time(bank: SceneBank, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]

    def slow() -> np.ndarray:
        clock[0] += 1.0
        return np.zeros((1, 1), np.float32)

    monkeypatch.setattr(runner, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    agent = StillAgent()
    agent.env_options = {"observation": OwnPart(slow, 1)}
    (record,) = evaluate(agent, episodes=1, bank=bank, step_limit=4).records
    assert record.action_time >= 1.0


class Inimitable(StillAgent):
    """Is never done being copied."""

    def __deepcopy__(self, memo: Any) -> Any:
        endless()


def test_a_copy_that_never_ends_is_given_up(bank: SceneBank, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "GRACE", 0.1)
    with pytest.raises(AgentError, match=r"cannot be copied .*timed out after 0\.1 s"):
        evaluate(Inimitable(), episodes=2, bank=bank, num_envs=2, timeout=0.1, step_limit=1)


class Name(str):
    __slots__ = ()

    def __str__(self) -> str:
        sys.exit("no name")

    __repr__ = __str__
    __format__ = lambda self, _: sys.exit("no name")  # noqa: E731


class Secretive(StillAgent):
    """Quits when it is asked for one of its attributes."""

    def __init__(self, *secrets: str):
        super().__init__()
        self.secrets = secrets

    def __getattribute__(self, name: str) -> Any:
        return sys.exit(name) if name in object.__getattribute__(self, "secrets") else super().__getattribute__(name)


@pytest.mark.parametrize("secret", ["name", "env_options", "knows_truth", "knows_scene", "act_many"])
def test_an_agent_that_quits_when_it_is_asked_ends_no_comparison(bank: SceneBank, secret: str) -> None:
    named = StillAgent()
    named.name = Name("named")
    lost, odd, still = compare([Secretive(secret), named, StillAgent()], episodes=1, bank=bank, step_limit=1)
    assert (lost.agent, odd.agent) == ("Secretive", "named")
    assert f"SystemExit: {secret}" in lost.error
    assert len(odd.records) == len(still.records) == 1


def test_what_is_no_agent_is_refused_before_any_agent_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollouts, "evaluate", lambda *_, **__: pytest.fail("one was run"))
    with pytest.raises(InvalidValueError, match="is no agent"):
        compare([StillAgent(), object()])  # type: ignore[list-item]


def test_one_process_at_a_time_runs_a_track(tmp_path: Path) -> None:
    with (
        exclusive(tmp_path, only="still.trial.reconstruction.jsonl"),
        pytest.raises(FileWriteError, match=r"still\.trial\.reconstruction\.jsonl: .*another process is at work"),
    ):
        submit(StillAgent(), "still", tmp_path, ["reconstruction"], SHORT)


class Ending(StillAgent):
    """Ends its process."""

    name = "ending"

    def act(self, observation: Any) -> Any:
        os._exit(7)


class EndingOnArrival(StillAgent):
    """Ends the process that it is sent to."""

    name = "ending on arrival"

    def __reduce__(self) -> Any:
        return os._exit, (7,)


class HangingOnArrival(StillAgent):
    """Never arrives in a worker process."""

    name = "hanging on arrival"

    def __reduce__(self) -> Any:
        return sum, (itertools.repeat(1),)


class HangingOnDeparture(StillAgent):
    """Cannot be pickled within any time."""

    name = "hanging on departure"

    def __reduce__(self) -> Any:
        while True:
            time.sleep(0.01)


class LeavingChildren(StillAgent):
    """Leaves a child process behind at each step."""

    name = "leaving children"

    def act(self, observation: Any) -> Any:
        if not os.fork():
            time.sleep(60)
            os._exit(0)
        return super().act(observation)


class Blocking(StillAgent):
    """Never lets another thread run."""

    name = "blocking"

    def act(self, observation: Any) -> Any:
        return sum(itertools.repeat(1))


@pytest.mark.slow
def test_an_agent_that_ends_or_blocks_its_process_ends_no_comparison_in_processes(bank: SceneBank) -> None:
    agents = [
        Ending(),
        EndingOnArrival(),
        HangingOnArrival(),
        Blocking(),
        HangingOnDeparture(),
        Forking(),
        StillAgent(),
    ]
    with processes(2) as executor:
        *lost, leaving, still = compare(agents, episodes=4, bank=bank, step_limit=4, executor=executor, timeout=10.0)
    for agent, evaluation in zip(agents, lost, strict=False):
        departed = agent.name != HangingOnDeparture.name
        told = ": a worker process ended" if departed else " cannot be sent to another process: timed out after 10 s"
        assert evaluation.error.startswith(f"agent '{agent.name}'{told}")
    assert [record.failure for record in (*leaving.records, *still.records)] == [""] * 8


def test_ctrl_c_still_ends_it(bank: SceneBank) -> None:
    class Interrupted(StillAgent):
        def act(self, observation: Any) -> Any:
            raise KeyboardInterrupt

    for timeout in (None, 60.0):
        with pytest.raises(KeyboardInterrupt):
            evaluate(Interrupted(), episodes=1, bank=bank, timeout=timeout)


@pytest.mark.parametrize("timeout", [0, -1.0, math.inf, math.nan, 1e300, "1", True, [1]])
def test_a_timeout_that_is_none_is_no_fault_of_the_agent(bank: SceneBank, timeout: Any) -> None:
    for run in (evaluate, retrace):
        with pytest.raises(InvalidValueError, match="timeout must be a positive number of seconds"):
            run(StillAgent(), seeds=[0], episodes=1, bank=bank, timeout=timeout) if run is evaluate else run(
                StillAgent(), [0], bank=bank, timeout=timeout
            )


class Privileged(StillAgent):
    """Declares that it may know the truth, or fails when asked whether it does."""

    name = "privileged"

    def __init__(self, fault: str = ""):
        super().__init__()
        self.fault = fault

    @property
    def knows_truth(self) -> bool:
        return FAULTS[self.fault][0]() if self.fault else True


def test_an_agent_that_declares_to_know_the_truth_is_marked(bank: SceneBank, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="changes the rules of the leaderboard: knows_truth=True"):
        submit(Privileged(), "privileged", tmp_path, ["reconstruction"], SHORT)
    told, failing, still = compare([Privileged(), Privileged("quits"), StillAgent()], episodes=1, bank=bank)
    assert (told.rules, still.rules) == ("knows_truth=True", "")
    assert "SystemExit: 3" in failing.error


# -- rules ------------------------------------------------------------------------------------------------------------


class Lies(WaypointAgent):
    name = "lies"

    def __init__(self, **options: Any):
        super().__init__()
        self.env_options: Mapping[str, Any] = {**WaypointAgent.env_options, **options}


class Equal(float):
    """A number that says it is equal to any other."""

    def __eq__(self, other: object) -> bool:
        return True

    __hash__ = float.__hash__


BENT: list[dict[str, Any]] = [
    {"success_radius": 1.0, "step_limit": 100_000},
    {"success_radius": 0.021},
    {"rate": 10},
    {"start": "folded"},
    {"start": [0.0] * 6},
    {"physics": "truth"},
    {"robot": "iiwa14"},
    {"reward": "sparse"},
    {"capacity": 5000},
    {"difficulty": "easy"},
    {"split": "train"},
    {"bank": "default"},
    {"start": np.zeros(3)},
    {"start": UnprintableError()},
]


@pytest.mark.parametrize("options", BENT, ids=range(len(BENT)))
def test_no_rule_of_the_leaderboard_can_be_bent(
    options: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leaderboard, "evaluate", lambda *_, **__: pytest.fail("it was played"))
    with pytest.raises(InvalidValueError, match=next(iter(options))):
        submit(Lies(**options), "lies", tmp_path, ["reconstruction"], SHORT)
    assert not list(tmp_path.iterdir())


def test_rules_that_are_named_as_they_are_do_no_harm(tmp_path: Path) -> None:
    agent = Lies(success_radius=0.02, step_limit=200, rate=20.0, task="reach", robot="ur5e", split="validation")
    entry = read_entry(submit(agent, "lies", tmp_path, ["reconstruction"], SHORT))
    assert not entry.evaluation("reconstruction").rules


def test_a_value_that_claims_to_be_the_rule_has_no_effect(bank: SceneBank) -> None:
    liar = evaluate(Lies(success_radius=Equal(1.0)), episodes=2, bank=bank)
    honest = evaluate(WaypointAgent(), episodes=2, bank=bank)
    assert [r.steps for r in liar.records] == [r.steps for r in honest.records]


def test_an_agent_that_bends_rules_only_while_it_plays_gets_no_entry(tmp_path: Path) -> None:
    class Late(StillAgent):
        asked = 0

        @property
        def env_options(self) -> Mapping[str, Any]:  # type: ignore[override]
            self.asked += 1
            return {"success_radius": 1.0} if self.asked > 3 else {}

    for _ in range(4):
        with pytest.raises(InvalidValueError, match=r"changes the rules of the leaderboard: success_radius=1\.0"):
            submit(Late(), "late", tmp_path, ["reconstruction", "truth"], SHORT)
    assert not list(tmp_path.glob("*.json"))


@pytest.fixture(scope="module")
def bent(bank: SceneBank) -> tuple[Evaluation, ...]:
    return compare([Lies(success_radius=1.0, step_limit=20), Lies(), WaypointAgent()], episodes=3, bank=bank)


def test_changed_rules_are_recorded_and_shown(bent: tuple[Evaluation, ...], tmp_path: Path) -> None:
    liar, honest, other = bent
    assert {record.rules for record in liar.records} == {"success_radius=1.0, step_limit=20"}
    assert {record.rules for record in (*honest.records, *other.records)} == {""}
    table = comparison_table(bent)
    assert "| lies * " in table
    assert "* lies changed the rules of its episodes: success_radius=1.0, step_limit=20" in table
    journal = RecordJournal(tmp_path / "records.jsonl", {})
    journal.add(0, liar.records[0])
    assert "success_radius=1.0" in (tmp_path / "records.jsonl").read_text()


def test_agents_are_not_paired_under_different_rules(bent: tuple[Evaluation, ...]) -> None:
    liar, honest, other = bent
    assert [(p.first, p.second) for p in pairings(bent)] == [("lies", "roadmap")]
    assert len(pairs_table(bent).rows) == 1
    with pytest.raises(InvalidValueError, match="no episode in common"):
        pairing(liar, other)
    assert pairing(honest, other).episodes == 3


def test_the_command_shows_them(tmp_path: Path) -> None:
    code = tmp_path / "liar.py"
    code.write_text(
        "from greenhouse_gym.agents import StraightLineAgent\n"
        "class Liar(StraightLineAgent):\n    name = 'liar'\n"
        "    env_options = {'success_radius': 1.0, 'action': 'joint'}\n"
    )
    asked = [f"{code}:Liar", "straight-line", "--bank", "mini", "--episodes", "1"]
    result = CliRunner().invoke(app, ["compare", *asked])
    assert result.exit_code == 0, repr(result.exception)
    assert "liar changed the rules of its episodes: success_radius=1.0" in " ".join(result.output.split())
    assert "McNemar" not in result.output
    refused = CliRunner().invoke(app, ["submit", asked[0], "--out", str(tmp_path), "--episodes", "1"])
    assert refused.exit_code != 0
    assert isinstance(refused.exception, InvalidValueError | SystemExit)


# -- entries ----------------------------------------------------------------------------------------------------------


def entry_of(*records: Record) -> dict[str, Any]:
    return Entry(
        agent="a",
        protocol=replace(SHORT, episodes=len(records)).as_json(),
        bank_sha256="0" * 64,
        versions={},
        machine={},
        tracks={"truth": columns_of(records)},
    ).model_dump(mode="json")


def test_entries_hold_records_under_the_same_rules_only(bent: tuple[Evaluation, ...]) -> None:
    liar, honest, _ = bent
    assert Entry(**entry_of(*honest.records)).evaluation("truth").records[0].rules == ""
    with pytest.raises(ValueError, match=r"under other rules: success_radius=1\.0"):
        entry_of(*liar.records)
