"""An evaluation that is interrupted loses no episode that is over."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from parallel_helpers import Elsewhere
from typer.testing import CliRunner

from greenhouse_gym.agents import Problem, RandomAgent
from greenhouse_gym.cli.main import app
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.evaluation import AgentError, Record, evaluate
from greenhouse_gym.evaluation.journal import RecordJournal, checksum_of
from greenhouse_gym.evaluation.leaderboard import CURRENT, read_entry, submit
from greenhouse_gym.scene import SceneBank

ABOUT = {"agent": "random", "bank": "mini"}
SHORT = replace(CURRENT, bank="mini", split="validation", episodes=3)


class Interrupted(RandomAgent):
    """Random agent that is interrupted after a number of episodes."""

    def __init__(self, episodes: int):
        super().__init__()
        self.left = episodes

    def reset(self, problem: Problem) -> None:
        if not self.left:
            raise KeyboardInterrupt
        self.left -= 1
        super().reset(problem)


def untimed(records: tuple[Record, ...]) -> list[Record]:
    return [replace(record, planning_time=0.0, action_time=0.0) for record in records]


@pytest.mark.parametrize("executor", [None, Elsewhere()])
def test_an_interrupted_evaluation_goes_on(bank: SceneBank, tmp_path: Path, executor: Any) -> None:
    whole = evaluate(RandomAgent(), episodes=4, bank=bank).records
    file = tmp_path / "records.jsonl"
    with pytest.raises(KeyboardInterrupt):
        evaluate(Interrupted(2), episodes=4, bank=bank, journal=RecordJournal(file, ABOUT))
    agent = Interrupted(2)
    again = evaluate(agent, episodes=4, bank=bank, journal=RecordJournal(file, ABOUT), executor=executor).records
    assert untimed(again) == untimed(whole)
    assert executor is not None or agent.left == 0, "two episodes were left"
    none_left = Interrupted(0)
    assert evaluate(none_left, episodes=4, bank=bank, journal=RecordJournal(file, ABOUT)).records == again
    assert evaluate(none_left, episodes=2, bank=bank, journal=RecordJournal(file, ABOUT)).records == again[:2]


@pytest.fixture(scope="module")
def content(bank: SceneBank, tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("kept") / "records.jsonl"
    evaluate(RandomAgent(), episodes=3, bank=bank, journal=RecordJournal(file, ABOUT))
    return file.read_text()


def test_a_line_that_was_being_written_is_played_again(content: str, tmp_path: Path) -> None:
    file = tmp_path / "records.jsonl"
    file.write_text(content[:-20])
    kept = RecordJournal(file, ABOUT)
    assert list(kept.records) == [0, 1]
    kept.add(2, kept.records[0])
    assert list(RecordJournal(file, ABOUT).records) == [0, 1, 2]


def test_records_of_something_else_are_not_taken(content: str, tmp_path: Path) -> None:
    file = tmp_path / "records.jsonl"
    file.write_text(content)
    assert RecordJournal(file, {**ABOUT, "agent": "another"}).records == {}
    assert RecordJournal(file, ABOUT).records == {}, "the file was overwritten"


@pytest.mark.parametrize(
    "spoil",
    [
        lambda line: line.replace('"seed"', '"sed"'),
        lambda line: line[10:],
        lambda line: "[]",
        lambda line: line.replace('"index"', '"palace"'),
    ],
)
def test_a_damaged_line_is_named(content: str, tmp_path: Path, spoil: Callable[[str], str]) -> None:
    file = tmp_path / "records.jsonl"
    header, first, *others = content.split("\n")
    file.write_text("\n".join([header, spoil(first), *others]))
    with pytest.raises(FileFormatError, match=r"records.jsonl.*line 2 is not a record"):
        RecordJournal(file, ABOUT)


def test_an_interrupted_entry_goes_on(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        submit(Interrupted(2), "random", tmp_path, ["truth"], SHORT)
    assert [path.name for path in tmp_path.iterdir()] == ["random.trial.truth.jsonl"]
    entry = read_entry(submit(Interrupted(1), "random", tmp_path, ["truth"], SHORT))
    assert [path.name for path in tmp_path.iterdir()] == ["random.trial.json"]
    whole = read_entry(submit(RandomAgent(), "random", tmp_path / "whole", ["truth"], SHORT))
    assert untimed(entry.evaluation("truth").records) == untimed(whole.evaluation("truth").records)


class Broken(RandomAgent):
    def act(self, observation: Any) -> Any:
        raise ZeroDivisionError


def test_records_of_an_agent_that_never_acted_do_not_outlive_the_error(bank: SceneBank, tmp_path: Path) -> None:
    file = tmp_path / "records.jsonl"
    with pytest.raises(AgentError):
        evaluate(Broken(), episodes=2, bank=bank, journal=RecordJournal(file, ABOUT), executor=Elsewhere())
    assert not file.exists(), "the next attempt starts from the beginning"


def test_an_agent_whose_file_has_changed_begins_anew(tmp_path: Path) -> None:
    source = tmp_path / "own.py"
    source.write_text("from greenhouse_gym.agents import RandomAgent\n")
    out = tmp_path / "entries"
    for change in ("", "# changed\n"):
        source.write_text(source.read_text() + change)
        with pytest.raises(KeyboardInterrupt):
            submit(Interrupted(2), f"{source}:RandomAgent", out, ["reconstruction"], SHORT)
    assert (out / "own.py-RandomAgent.trial.reconstruction.jsonl").read_text().count('"index"') == 2


@pytest.mark.parametrize("name", ["run", "run/policy.json", "run/policy", "run/mine.py:Mine"])
def test_the_checksum_of_an_agent_covers_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run").mkdir()
    for suffix in (".json", ".safetensors"):
        Path("run/policy").with_suffix(suffix).write_text("0")
    Path("run/mine.py").write_text("0")
    before = checksum_of(RandomAgent(), name)
    changed = Path("run/mine.py") if "mine" in name else Path("run/policy.safetensors")
    changed.write_text("1")
    assert checksum_of(RandomAgent(), name) != before


AGENT = """
import os
from pathlib import Path
from greenhouse_gym.agents import StraightLineAgent
PLAYED = Path(__file__).resolve().with_name("played")
class Mine(StraightLineAgent):
    name = "mine"
    def reset(self, problem):
        super().reset(problem)
        with PLAYED.open("a") as file:
            file.write("x")
        os.chdir("/")
        if PLAYED.stat().st_size == 4:
            raise KeyboardInterrupt
"""


def test_a_comparison_with_a_report_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    (tmp_path / "mine.py").write_text(AGENT)
    words = ["compare", "random", "mine.py:Mine", "--bank", "mini", "--episodes", "2", "--report", "r.html"]
    words += ["--track", "reconstruction,truth"]
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(app, words).exit_code == 130
    assert len(list((tmp_path / "r.html.journal").iterdir())) == 4
    monkeypatch.chdir(tmp_path)
    resumed = CliRunner().invoke(app, words)
    assert resumed.exit_code == 0, resumed.output
    played_again = 2  # for the report
    assert (tmp_path / "played").stat().st_size == 4 + 1 + played_again
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.py", "played", "r.html"]
