from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from greenhouse_gym.agents import RandomAgent, StillAgent
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.leaderboard import TRACKS, V1, Entry, is_current, leaderboard_table, read_entry, replay, submit
from greenhouse_gym.records import Evaluation, Record, pairing
from greenhouse_gym.scene import SceneBank

SHORT = replace(V1, bank="mini", split="validation", episodes=2)
ENTRIES = sorted((Path(__file__).parents[1] / "benchmarks" / "leaderboard").glob("*.json"))


@pytest.fixture(scope="module")
def entry(tmp_path_factory: pytest.TempPathFactory) -> Entry:
    return read_entry(submit(RandomAgent(), "random", tmp_path_factory.mktemp("entries"), protocol=SHORT, note="dice"))


def test_an_entry_holds_what_was_played(entry: Entry) -> None:
    assert list(entry.tracks) == list(TRACKS)
    assert entry.bank_sha256 == SceneBank.open("mini").sha256
    assert is_current(entry)
    for track in TRACKS:
        records = entry.evaluation(track).records
        assert [record.seed for record in records] == [0, 1]
    told, true = ([(r.scene, r.target) for r in entry.evaluation(t).records] for t in ("reconstruction", "truth"))
    assert told == true, "all tracks have the same episodes"


def test_an_entry_can_be_played_again(entry: Entry) -> None:
    for before, now in replay(entry, RandomAgent(), "truth", 1):
        assert (before.success, before.collision, before.steps) == (now.success, now.collision, now.steps)
        assert before.joint_length == pytest.approx(now.joint_length, abs=1e-5)
    still = replay(entry, StillAgent(), "truth", 1)
    assert still[0][0].joint_length != still[0][1].joint_length, "a replay by somebody else is found out"


def test_entries_of_another_bank_are_not_ranked(entry: Entry) -> None:
    stale = entry.model_copy(update={"bank_sha256": "0" * 64, "agent": "old"})
    table = leaderboard_table([entry, stale])
    assert table.count("| random |") == 3
    assert "| old |" not in table
    assert "to be submitted again: old" in table


def test_damaged_entries_and_unknown_tracks_are_refused(entry: Entry, tmp_path: Path) -> None:
    broken = tmp_path / "broken.json"
    broken.write_text(json.dumps({**json.loads(entry.model_dump_json()), "tracks": 3}))
    with pytest.raises(FileFormatError, match="tracks"):
        read_entry(broken)
    with pytest.raises(InvalidValueError, match="moved"):
        submit(RandomAgent(), "random", tmp_path, ["rumor"], SHORT)


@pytest.mark.parametrize("path", ENTRIES, ids=lambda path: path.stem)
def test_what_is_on_the_leaderboard_comes_out_again(path: Path) -> None:
    entry = read_entry(path)
    track = next(iter(entry.tracks))
    records = entry.evaluation(track).records
    seconds = sum(record.planning_time + record.steps * record.action_time for record in records) / len(records)
    _comes_out_again(entry, track, episodes=10 if seconds < 3.0 else 3)


@pytest.mark.slow
@pytest.mark.parametrize("path", ENTRIES, ids=lambda path: path.stem)
def test_what_is_on_the_leaderboard_comes_out_again_on_every_track(path: Path) -> None:
    entry = read_entry(path)
    for track in entry.tracks:
        _comes_out_again(entry, track, episodes=10)


def _comes_out_again(entry: Entry, track: str, episodes: int) -> None:
    if not is_current(entry):
        pytest.skip("of an earlier bank: the table does not rank it")
    pairs = replay(entry, make_agent(entry.agent), track, episodes)
    same = sum(before.success == now.success and before.steps == now.steps for before, now in pairs)
    assert same >= 9 * episodes // 10, "another machine may round one episode in ten to another end"


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
