"""The leaderboard's track of harvests: entry, tables and report of two stands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from greenhouse_gym.agents import RandomAgent
from greenhouse_gym.agents.harvest.harvester import OracleHarvester
from greenhouse_gym.agents.harvest.scan_harvester import ScanHarvester
from greenhouse_gym.cli.main import app
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation import leaderboard
from greenhouse_gym.evaluation.entry import STANDS
from greenhouse_gym.evaluation.leaderboard import (
    CURRENT,
    TRACKS,
    leaderboard_table,
    read_entry,
    replay,
    submit,
    tracks_of,
)
from greenhouse_gym.reporting.comparison import leaderboard_report

SHORT = replace(CURRENT, bank="mini", split="validation", episodes=2)
QUICK = {**TRACKS["harvest"], "step_limit": 5}
HEADS = ["agent", "stands", "fruit", "crated", "s a fruit", "dropped", "missed", "knocked off / 100", "damaged / 100"]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leaderboard, "TRACKS", {**TRACKS, "harvest": QUICK})


def test_an_entry_of_two_stands_is_ranked_by_fruit_and_can_be_played_again(tmp_path: Path) -> None:
    entry = read_entry(submit(RandomAgent(), "random", tmp_path, ["harvest"], SHORT))
    table = leaderboard_table([entry], SHORT)
    assert [head.strip() for head in table.splitlines()[2].strip("|").split("|")] == HEADS
    ((before, now),) = replay(entry, RandomAgent(), "harvest", 1)
    assert (before.measures, before.steps) == (now.measures, now.steps)
    page = leaderboard_report([entry], SHORT)
    assert "Track harvest" in page
    assert "<iframe" not in page, "a scene page shows plants at rest"


def test_each_agent_has_the_tracks_of_its_task() -> None:
    assert tracks_of(ScanHarvester()) == ("harvest",)
    assert tracks_of(RandomAgent()) == ("reconstruction", "truth", "moved", "brush")
    assert (CURRENT.episodes_on("truth"), CURRENT.episodes_on("harvest"), SHORT.episodes_on("harvest")) == (
        1000,
        STANDS,
        2,
    )


def test_an_oracle_has_no_entry(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="knows_truth"):
        submit(OracleHarvester(), "harvest-oracle", tmp_path, protocol=SHORT)


def test_a_comparison_prints_the_metrics_of_the_field() -> None:
    options = ["--track", "harvest", "--bank", "mini", "--split", "validation", "--episodes", "2"]
    result = CliRunner().invoke(app, ["compare", "random", *options], catch_exceptions=False)
    assert all(head in result.output for head in HEADS)
