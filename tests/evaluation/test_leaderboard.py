from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from parallel_helpers import Elsewhere
from still_agent import StillAgent
from typer.testing import CliRunner

from greenhouse_gym.agents import RandomAgent
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.cli.main import app
from greenhouse_gym.common.executors import workers_of
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError
from greenhouse_gym.evaluation import leaderboard
from greenhouse_gym.evaluation.entry import HARVEST
from greenhouse_gym.evaluation.leaderboard import (
    CURRENT,
    Entry,
    follows,
    is_current,
    leaderboard_table,
    read_entry,
    replay,
    submit,
    tracks_of,
)
from greenhouse_gym.evaluation.records import Evaluation, Record, pairing
from greenhouse_gym.scene import SceneBank

REACHES = tracks_of(RandomAgent())
SHORT = replace(CURRENT, bank="mini", split="validation", episodes=2)
FOLDER = Path(__file__).parents[2] / "benchmarks" / "leaderboard"
ENTRIES = sorted(path for path in FOLDER.glob("*.json") if not path.name.endswith(".trial.json"))


@pytest.fixture(scope="module")
def entry(tmp_path_factory: pytest.TempPathFactory) -> Entry:
    return read_entry(submit(RandomAgent(), "random", tmp_path_factory.mktemp("entries"), protocol=SHORT, note="dice"))


def test_an_entry_holds_what_was_played(entry: Entry) -> None:
    assert list(entry.tracks) == list(REACHES)
    assert entry.bank_sha256 == SceneBank.open("mini").sha256
    assert is_current(entry)
    for track in REACHES:
        records = entry.evaluation(track).records
        assert [record.seed for record in records] == [0, 1]
    known, true = ([(r.scene, r.target) for r in entry.evaluation(t).records] for t in ("reconstruction", "truth"))
    assert known == true, "the tracks with the same targets have the same episodes"
    assert all("brushed_time" in record.measures for record in entry.evaluation("brush").records)


def test_an_entry_can_be_played_again(entry: Entry) -> None:
    for before, now in replay(entry, RandomAgent(), "truth", 1):
        assert (before.success, before.collision, before.steps) == (now.success, now.collision, now.steps)
        assert before.joint_length == pytest.approx(now.joint_length, abs=1e-5)
    still = replay(entry, StillAgent(), "truth", 1)
    assert still[0][0].joint_length != still[0][1].joint_length, "a replay by another agent is detected"


def test_an_entry_says_what_its_agent_knows(entry: Entry, tmp_path: Path) -> None:
    assert entry.knows == "observation"
    one = replace(SHORT, episodes=1)
    knows = {
        "ppo-ur5e": "observation",
        "ppo-roadmap-ur5e": "scene",
        "shielded-ppo-ur5e": "scene",
        "straight-line": "scene",
    }
    entries = [read_entry(submit(make_agent(name), name, tmp_path, ["reconstruction"], one)) for name in knows]
    assert {entry.agent: entry.knows for entry in entries} == knows
    assert re.search(r"straight-line +\| +scene", leaderboard_table(entries, one))


class Dice(RandomAgent):
    """Random agent that leaves the kind of action to the environment."""

    env_options: Mapping[str, Any] = {}


def test_an_agent_plays_again_with_the_action_of_its_entry(tmp_path: Path) -> None:
    path = submit(Dice(), "dice", tmp_path, ["reconstruction"], replace(SHORT, episodes=1))
    content = json.loads(path.read_text())
    assert content["action"] == "tip_velocity"
    ((before, now),) = replay(read_entry(path), Dice(), "reconstruction")
    assert (before.steps, before.tip_length) == (now.steps, pytest.approx(now.tip_length, abs=1e-5))
    del content["action"]  # as entries from before that was the default
    path.write_text(json.dumps(content))
    ((_, old),) = replay(read_entry(path), Dice(), "reconstruction")
    ((_, joint),) = replay(read_entry(path), RandomAgent(), "reconstruction")
    assert old.tip_length == joint.tip_length != now.tip_length


def ranked(table: str) -> list[tuple[str, str]]:
    """Return track and agent of each row of a leaderboard."""
    parts = [part.splitlines() for part in table.split("track ")[1:]]
    return [(lines[0], row.split("|")[1].strip()) for lines in parts for row in lines[4:] if row.startswith("|")]


def test_entries_of_another_bank_are_not_ranked(entry: Entry) -> None:
    stale = entry.model_copy(update={"bank_sha256": "0" * 64, "agent": "old"})
    table = leaderboard_table([entry, stale], SHORT)
    assert [agent for _, agent in ranked(table)] == ["random"] * len(REACHES)
    assert "to be submitted again: old" in table
    assert "Trials" not in table


def test_trials_are_not_ranked(entry: Entry) -> None:
    gone = entry.model_copy(update={"protocol": {**entry.protocol, "bank": "gone"}, "agent": "elsewhere"})
    table = leaderboard_table([entry, gone])
    assert not follows(entry)
    assert not ranked(table)
    assert "Trials that do not follow the current protocol: random, elsewhere." in table


def with_successes(entry: Entry, agent: str, **successes: list[bool]) -> Entry:
    tracks = {track: {**entry.tracks[track], "success": list(won)} for track, won in successes.items()}
    return entry.model_copy(update={"agent": agent, "tracks": tracks})


def test_entries_are_ranked_within_each_track(entry: Entry) -> None:
    table = leaderboard_table(
        [
            with_successes(entry, "even", reconstruction=[True, True], truth=[False, False]),
            with_successes(entry, "true", truth=[True, False]),
            with_successes(entry, "poor", moved=[False, False], reconstruction=[True, False]),
        ],
        SHORT,
    )
    best_first = [("reconstruction", "even"), ("reconstruction", "poor"), ("truth", "true"), ("truth", "even")]
    assert ranked(table) == [*best_first, ("moved", "poor")]


def test_a_trial_leaves_the_entry_alone(entry: Entry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leaderboard, "CURRENT", SHORT)
    proper = submit(RandomAgent(), "random", tmp_path, ["truth"], SHORT)
    before = proper.read_bytes()
    trial = submit(RandomAgent(), "random", tmp_path, ["truth"], replace(SHORT, episodes=1))
    assert (proper.name, trial.name) == ("random.json", "random.trial.json")
    assert proper.read_bytes() == before
    assert len(read_entry(trial).evaluation("truth").records) == 1


def test_tracks_of_an_entry_are_kept_where_all_else_agrees(
    entry: Entry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "random.trial.json"
    monkeypatch.setattr(leaderboard, "evaluate", lambda *_, **__: entry.evaluation("reconstruction"))

    def then(**changes: Any) -> Entry:
        path.write_text(entry.model_copy(update=changes).model_dump_json())
        return read_entry(submit(RandomAgent(), "random", tmp_path, ["truth"], SHORT, num_envs=2))

    kept = then(machine={"cores": "99"})
    assert set(kept.tracks) == set(REACHES)
    assert kept.tracks["moved"] == entry.tracks["moved"]
    assert kept.tracks["truth"] == entry.tracks["reconstruction"], "what was played now"
    assert kept.note == "dice"
    assert kept.machine["cores"] == "99", "for the tracks that were there"
    assert (kept.at_once("truth"), kept.at_once("moved")) == ("2 x 1", "? x ?")
    for changes in (
        {"agent": "somebody"},
        {"bank_sha256": "0" * 64},
        {"versions": {**entry.versions, "mujoco": "1.0"}},
        {"protocol": {**entry.protocol, "timeout": 1.0}},
    ):
        assert list(then(**changes).tracks) == ["truth"], changes


def test_tracks_that_are_played_at_the_same_time_are_all_kept(
    entry: Entry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def play(*_: object, physics: str = "", **__: object) -> Evaluation:
        if physics:
            submit(RandomAgent(), "random", tmp_path, ["reconstruction"], SHORT)
        return entry.evaluation("truth")

    monkeypatch.setattr(leaderboard, "evaluate", play)
    path = submit(RandomAgent(), "random", tmp_path, ["truth"], SHORT)
    assert set(read_entry(path).tracks) == {"reconstruction", "truth"}


def test_a_damaged_entry_is_told_before_anything_is_played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leaderboard, "evaluate", lambda *_, **__: pytest.fail("it was played"))
    (tmp_path / "random.trial.json").write_text("{")
    with pytest.raises(FileFormatError, match=r"random\.trial\.json"):
        submit(RandomAgent(), "random", tmp_path, ["truth"], SHORT)


def timeless(entry: Entry, track: str) -> dict[str, list[Any]]:
    return {name: values for name, values in entry.tracks[track].items() if not name.endswith("_time")}


def test_an_entry_is_the_same_wherever_it_is_played_and_says_where(entry: Entry, tmp_path: Path) -> None:
    executor = Elsewhere()
    path = submit(RandomAgent(), "random", tmp_path, ["truth"], SHORT, num_envs=2, executor=executor)
    assert executor.works, "the executor had something to do"
    spread = read_entry(path)
    assert timeless(spread, "truth") == timeless(entry, "truth")
    assert spread.machine["truth: workers"] == str(workers_of(executor))
    assert entry.at_once("truth") == "1 x 1"


def test_the_command_plays_in_processes(entry: Entry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leaderboard, "CURRENT", SHORT)
    asked = ["submit", "random", "--out", str(tmp_path), "--track", "truth", "--episodes", "1"]
    result = CliRunner().invoke(app, [*asked, "--backend", "processes", "--workers", "2"])
    assert result.exit_code == 0, repr(result.exception)
    assert "track truth" in result.output
    assert "| random " in result.output
    trial = read_entry(tmp_path / "random.trial.json")
    assert timeless(trial, "truth") == {name: values[:1] for name, values in timeless(entry, "truth").items()}
    assert trial.at_once("truth") == "1 x 2"


def test_damaged_entries_and_unknown_tracks_are_refused(entry: Entry, tmp_path: Path) -> None:
    broken = tmp_path / "broken.json"
    broken.write_text(json.dumps({**json.loads(entry.model_dump_json()), "tracks": 3}))
    with pytest.raises(FileFormatError, match="tracks"):
        read_entry(broken)
    with pytest.raises(InvalidValueError, match="moved"):
        submit(RandomAgent(), "random", tmp_path, ["rumor"], SHORT)


TRACK_DAMAGES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a column is missing": lambda track: track.pop("seed"),
    "a column is too short": lambda track: track["steps"].pop(),
    "all columns are too short": lambda track: [values.pop() for values in track.values()],
    "there are no records": lambda track: [values.clear() for values in track.values()],
    "there are no columns": lambda track: track.clear(),
    "a column is unknown": lambda track: track.update(luck=[1, 2]),
    "the column of another": lambda track: track.update(measures=[{"a": "b"}, {}]),
    "other rules": lambda track: track.update(rules=["", "success_radius=1.0"]),
    **{
        f"{name} is {value!r}": lambda track, name=name, value=value: track[name].__setitem__(1, value)  # type: ignore[misc]
        for name, values in {
            "seed": ("1", None, 1.5, [1], {}, 0, 2, -1),
            "steps": (-1, 10**300, "1"),
            "success": (None, 1, "true", 0.0),
            "collision": (None, "false"),
            "contact": (None, "arm", [1], {"a": "b"}),
            "action_time": ("x", None, True, [0.1], "1.0", -0.1, math.nan, math.inf),
            "planning_time": ([1], "1", -1e-9),
            "scene": (None, 3, ["a"]),
            "difficulty": (None, 3, ["easy"]),
            "failure": (None, 0),
        }.items()
        for value in values
    },
}
ENTRY_DAMAGES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a bank of numbers": lambda entry: entry["protocol"].update(bank=[3]),
    "words for episodes": lambda entry: entry["protocol"].update(episodes="many"),
    "no protocol": lambda entry: entry.pop("protocol"),
    "a protocol of nothing": lambda entry: entry.update(protocol=None),
    "tracks in a list": lambda entry: entry.update(tracks=[entry["tracks"]]),
    "a track of numbers": lambda entry: entry["tracks"].update(truth=[1, 2]),
    "a name of numbers": lambda entry: entry.update(agent=3),
    "versions without numbers": lambda entry: entry.update(versions={"mujoco": None}),
}


@pytest.mark.parametrize("damage", [*TRACK_DAMAGES, *ENTRY_DAMAGES])
def test_every_damage_of_an_entry_names_its_file(entry: Entry, tmp_path: Path, damage: str) -> None:
    content = json.loads(entry.model_dump_json())
    if damage in ENTRY_DAMAGES:
        ENTRY_DAMAGES[damage](content)
    else:
        TRACK_DAMAGES[damage](content["tracks"]["truth"])
    path = tmp_path / "random.trial.json"
    path.write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match=r"random\.trial\.json: not a valid leaderboard entry"):
        leaderboard_table([read_entry(path)], SHORT)
    result = CliRunner().invoke(app, ["leaderboard", str(tmp_path)])
    assert isinstance(result.exception, FileFormatError | SystemExit)


def test_entries_under_rules_of_another_version_are_trials(entry: Entry, tmp_path: Path) -> None:
    content = json.loads(entry.model_dump_json())
    del content["protocol"]["bank"]
    content["protocol"]["gravity"] = 0
    path = tmp_path / "random.json"
    path.write_text(json.dumps(content))
    assert "Trials that do not follow the current protocol: random." in leaderboard_table([read_entry(path)], SHORT)
    assert not is_current(read_entry(path)), "the bank by default"


def test_an_entry_without_a_track_says_which_it_has(entry: Entry) -> None:
    part = entry.model_copy(update={"tracks": {"truth": entry.tracks["truth"]}})
    with pytest.raises(UnknownNameError, match=r"moved.*Choices: truth"):
        replay(part, RandomAgent(), "moved", 1)
    with pytest.raises(UnknownNameError, match="rumor"):
        entry.evaluation("rumor")


@pytest.mark.parametrize("path", ENTRIES, ids=lambda path: path.stem)
def test_what_is_on_the_leaderboard_comes_out_again(path: Path) -> None:
    entry = read_entry(path)
    track = next(iter(entry.tracks))
    if track == HARVEST:
        pytest.skip("a stand takes thousands of steps: the slow test repeats one")
    records = entry.evaluation(track).records
    seconds = sum(record.planning_time + record.steps * record.action_time for record in records) / len(records)
    _comes_out_again(entry, track, episodes=6 if seconds < 1.0 else 2)


@pytest.mark.slow
@pytest.mark.parametrize("path", ENTRIES, ids=lambda path: path.stem)
def test_what_is_on_the_leaderboard_comes_out_again_on_every_track(path: Path) -> None:
    entry = read_entry(path)
    for track in entry.tracks:
        _comes_out_again(entry, track, episodes=10)


def _comes_out_again(entry: Entry, track: str, episodes: int) -> None:
    if not is_current(entry):
        pytest.skip("of an earlier bank: the table does not rank it")
    if track == HARVEST:  # every contact of thousands of steps may round another way on another machine
        ((before, now),) = replay(entry, make_agent(entry.agent), track, 1)
        assert now.scene == before.scene
        wanted = before.measures["wanted"]
        assert now.measures["wanted"] == wanted
        assert abs(now.measures["crated"] - before.measures["crated"]) <= max(3, wanted // 3)
        return
    pairs = replay(entry, make_agent(entry.agent), track, episodes)
    same = sum(before.success == now.success and before.steps == now.steps for before, now in pairs)
    assert same >= max(1, 9 * episodes // 10), "another machine may round one episode in ten to another end"


def record(seed: int, success: bool) -> Record:
    return Record(seed, "s", 0, "easy", success, False, (), 1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_agents_are_paired_by_episode() -> None:
    first = Evaluation("a", tuple(record(k, k < 9) for k in range(12)))
    second = Evaluation("b", tuple(record(k, k >= 8) for k in reversed(range(12))))
    result = pairing(first, second)
    assert (result.episodes, result.only_first, result.only_second) == (12, 8, 3)
    assert result.p_value == pytest.approx(2 * sum([1, 11, 55, 165]) / 2**11)  # the exact test by hand
    assert "may be equally good" in str(result)
    assert pairing(first, first).p_value == 1.0
    with pytest.raises(InvalidValueError, match="in common"):
        pairing(first, Evaluation("c", (record(99, True),)))


def test_no_pairing_without_a_test_by_name() -> None:
    assert str(pairing(Evaluation("a", (record(0, True),)), Evaluation("b", (record(0, True),)))).endswith("p = 1")
