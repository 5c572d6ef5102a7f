"""Leaderboard: comparisons under a frozen protocol, stored as entries that anyone can replay."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from types import MappingProxyType
from typing import Any

from greenhouse_gym.agents import Agent
from greenhouse_gym.common.executors import workers_of
from greenhouse_gym.common.files import exclusive, write_atomically
from greenhouse_gym.common.tables import Table, number
from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.envs import EnvSettings, Randomization
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation.deadline import AskedAgent
from greenhouse_gym.evaluation.entry import (
    CURRENT,
    HARVEST,
    Entry,
    Protocol,
    columns_of,
    follows,
    is_current,
    read_entry,
)
from greenhouse_gym.evaluation.harvest import harvest_rows
from greenhouse_gym.evaluation.journal import RecordJournal, checksum_of, package_versions
from greenhouse_gym.evaluation.records import Evaluation, Record
from greenhouse_gym.evaluation.rollouts import AGENTS_CHOICE, changed_rules, evaluate, shown_rules
from greenhouse_gym.scene import DIFFICULTIES, SceneBank

__all__ = [
    "CURRENT", "TRACKS", "Entry", "Protocol", "follows", "is_current", "leaderboard_table", "read_entry", "replay",
    "submit",
]  # fmt: skip

TRACKS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "reconstruction": {},
        "truth": {"physics": "truth"},
        "moved": {"physics": "truth", "randomization": Randomization(plants=PlantMotion())},
        "brush": {"physics": "truth", "plants": "brush"},
        HARVEST: {
            "physics": "truth", "plants": "compliant", "task": "harvest", "size": "stand", "step_limit": 3600,
        },
    }
)  # fmt: skip
"""Simulated world of each track: the reconstruction itself, the true row, the true row after the plants moved, or the
true row with leaves that give way. Stands of "harvest" have compliant plants and end after 180 s, because an agent that
has given up only waits.

Agents always observe the reconstruction.
"""


def tracks_of(agent: Agent) -> tuple[str, ...]:
    """Return the tracks of an agent's task."""
    task = AskedAgent.of(agent).env_options.get("task", "reach")
    return tuple(track for track, world in TRACKS.items() if world.get("task", "reach") == task)


def difficulty_of(protocol: Protocol, track: str) -> tuple[str, ...]:
    """Return the difficulties of a track's targets: on "brush", also those that are unreachable with rigid leaves."""
    return DIFFICULTIES if track == "brush" else protocol.difficulty


def submit(
    agent: Agent,
    name: str,
    out: str | Path,
    tracks: Sequence[str] | None = None,
    protocol: Protocol = CURRENT,
    num_envs: int = 1,
    note: str = "",
    executor: Executor | None = None,
) -> Path:
    """Run the episodes of a protocol and write the entry, updated after each track.

    An existing entry keeps its other tracks if agent, protocol, bank and versions are the same. Records are stored in a
    journal ``NAME.TRACK.jsonl`` next to the entry until the track is complete, so that an interrupted run resumes.

    Args:
        agent: The agent.
        name: Name of the agent, as `make_agent` takes it. It also names the file: ``NAME.json``, or
            ``NAME.trial.json`` if the protocol is not the current one.
        out: Folder of the entries.
        tracks: Names of tracks from `TRACKS`; if None, those of the agent's task.
        protocol: The protocol.
        num_envs: Number of parallel episodes; only times depend on it.
        note: Free text; empty keeps the note of an existing entry.
        executor: Runs the episodes; see `greenhouse_gym.evaluation.evaluate`.

    Returns:
        Path of the entry.

    Raises:
        InvalidValueError: No track is given, or an unknown one; or the agent's ``env_options`` change the rules.
        FileFormatError: The existing entry is damaged.
        FileWriteError: Another process runs such a track, or a file cannot be written.
    """
    tracks = tracks_of(agent) if tracks is None else tracks
    if not tracks or not set(tracks) <= set(TRACKS):
        raise InvalidValueError(f"tracks must be some of {', '.join(TRACKS)}, got {', '.join(tracks) or 'none'}")
    stem = Path(name).name.replace(":", "-").removesuffix(".json")
    asked = AskedAgent.of(agent)
    action = asked.env_options.get("action", EnvSettings().action)
    path = Path(out).absolute() / (f"{stem}.json" if protocol == CURRENT else f"{stem}.trial.json")
    fresh = Entry(
        agent=name,
        note=note,
        protocol=protocol.as_json(),
        bank_sha256=SceneBank.open(protocol.bank).sha256,
        knows="scene" if asked.knows_scene else "observation",
        action=action if isinstance(action, str) else "own",
        versions=package_versions(),
        machine={},
        tracks={},
    )
    _merged(path, fresh)  # reports a damaged entry before any episode runs
    about = fresh.model_dump(include={"agent", "protocol", "bank_sha256", "action", "versions"}) | {
        "sha256": checksum_of(agent, name)
    }
    for track in tracks:
        changed = changed_rules(asked.name, asked.env_options, _settings(protocol, track))
        _check_rules(asked.name, shown_rules(changed, asked.knows_truth))
    for track in tracks:
        records = path.with_suffix(f".{track}.jsonl")
        with exclusive(path.parent, only=records.name):
            journal = RecordJournal(records, {**about, "track": track})
            evaluation = _run(agent, protocol, track, protocol.episodes_on(track), num_envs, executor, journal)
            machine = {f"{track}: {name}": value for name, value in _machine(num_envs, executor).items()}
            with exclusive(path.parent, only=path.name, wait=True):
                entry = _merged(path, fresh)  # other processes may have added tracks
                added = {
                    "machine": {**entry.machine, **machine},
                    "tracks": {**entry.tracks, track: columns_of(evaluation.records)},
                }
                write_atomically(path, entry.model_copy(update=added).model_dump_json() + "\n")
            journal.remove()
    return path


def replay(entry: Entry, agent: Agent, track: str, episodes: int = 10) -> list[tuple[Record, Record]]:
    """Repeat the first episodes of an entry and return pairs of its record and the new one."""
    before = entry.evaluation(track).records[:episodes]
    given: dict[str, Any] = {} if "action" in AskedAgent.of(agent).env_options else {"action": entry.action}
    now = _run(agent, entry.rules, track, len(before), **given).records
    return list(zip(before, now, strict=True))


def leaderboard_tables(entries: Sequence[Entry], protocol: Protocol = CURRENT) -> dict[str, Table]:
    """Return a table by track of the entries that follow a protocol on the present bank, best first."""
    ranked = [entry for entry in entries if follows(entry, protocol) and is_current(entry)]
    here = {track: [entry for entry in ranked if track in entry.tracks] for track in TRACKS}
    return {
        track: harvest_rows([entry.evaluation(track) for entry in found])
        if track == HARVEST
        else _reach_rows(found, track)
        for track, found in here.items()
        if found
    }


def _reach_rows(entries: Sequence[Entry], track: str) -> Table:
    heads = ["agent", "knows", "episodes", "success [95 %]", "collision", "first ms", "action ms", "at once", "steps"]
    rows = []
    here = [(entry, entry.evaluation(track)) for entry in entries]
    for entry, e in sorted(here, key=lambda pair: -pair[1].success_rate):
        low, high = e.success_interval
        rows.append(
            [
                entry.agent,
                entry.knows,
                str(len(e.records)),
                f"{e.success_rate:.1%} [{100 * low:.1f}, {100 * high:.1f}]",
                f"{e.collision_rate:.1%}",
                number(1e3 * (e.median("planning_time") + e.median("action_time")), ".1f"),
                number(1e3 * e.median("action_time"), ".2f"),
                entry.at_once(track),
                number(e.median("steps", solved_only=True), ".0f"),
            ]
        )
    return Table(heads, rows)


def leaderboard_notes(entries: Sequence[Entry], protocol: Protocol = CURRENT) -> list[str]:
    """Return notes on the entries that are not ranked: those of another bank, and those of another protocol."""
    proper = [entry for entry in entries if follows(entry, protocol)]
    stale = [entry.agent for entry in proper if not is_current(entry)]
    trials = [entry.agent for entry in entries if not follows(entry, protocol)]
    notes = [f"Made on an earlier bank, to be submitted again: {', '.join(stale)}."] if stale else []
    return [*notes, *([f"Trials that do not follow the current protocol: {', '.join(trials)}."] if trials else [])]


def leaderboard_table(entries: Sequence[Entry], protocol: Protocol = CURRENT) -> str:
    """Return the tables of `leaderboard_tables` as Markdown, with `leaderboard_notes` below them."""
    tables = leaderboard_tables(entries, protocol)
    shown = [f"track {track}\n\n{table.as_markdown()}" for track, table in tables.items()]
    return "\n".join([*shown, *(f"{note}\n" for note in leaderboard_notes(entries, protocol))])


def _merged(path: Path, fresh: Entry) -> Entry:
    """Return the existing entry if it can hold tracks of the fresh one, else the fresh one."""
    before = read_entry(path) if path.is_file() else fresh
    same = ("agent", "protocol", "bank_sha256", "action", "versions")
    if any(getattr(before, name) != getattr(fresh, name) for name in same):
        return fresh
    return before.model_copy(update={"note": fresh.note or before.note})


def _machine(num_envs: int, executor: Executor | None) -> dict[str, str]:
    return {
        "processor": platform.machine(),
        "cores": str(os.cpu_count()),
        "python": platform.python_version(),
        "num_envs": str(num_envs),
        "workers": str(1 if executor is None else workers_of(executor)),
    }


def _run(
    agent: Agent,
    protocol: Protocol,
    track: str,
    episodes: int,
    num_envs: int = 1,
    executor: Executor | None = None,
    journal: RecordJournal | None = None,
    **given: Any,
) -> Evaluation:
    evaluation = evaluate(
        agent,
        episodes=episodes,
        seed=protocol.seed,
        num_envs=num_envs,
        timeout=protocol.timeout,
        executor=executor,
        journal=journal,
        **_settings(protocol, track),
        **given,
    )
    _check_rules(evaluation.agent, evaluation.rules)
    return evaluation


def _settings(protocol: Protocol, track: str) -> dict[str, Any]:
    rules = {name: getattr(protocol, name) for name in ("bank", "split", "start")}
    return {**rules, "difficulty": difficulty_of(protocol, track), **TRACKS[track]}


def _check_rules(agent: str, changed: str) -> None:
    if changed:
        raise InvalidValueError(
            f"agent {agent!r} changes the rules of the leaderboard: {changed}; its env_options may choose "
            f"{' and '.join(AGENTS_CHOICE)} only"
        )
