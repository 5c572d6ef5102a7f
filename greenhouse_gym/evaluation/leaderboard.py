"""Leaderboard: comparisons under a frozen protocol, stored as entries that anyone can replay."""

from __future__ import annotations

import inspect
import json
import os
import platform
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from greenhouse_gym.agents import Agent
from greenhouse_gym.common.executors import workers_of
from greenhouse_gym.common.files import parsing, read_bytes, write_atomically
from greenhouse_gym.common.tables import Table
from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.envs.randomization import Randomization
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation.journal import RecordJournal
from greenhouse_gym.evaluation.records import Evaluation, Record
from greenhouse_gym.evaluation.rollouts import evaluate
from greenhouse_gym.scene import SceneBank

TRACKS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "reconstruction": {},
        "truth": {"physics": "truth"},
        "moved": {"physics": "truth", "randomization": Randomization(plants=PlantMotion())},
    }
)
"""Simulated world of each track: the reconstruction itself, the true row, or the true row after the plants moved.

Agents always observe the reconstruction.
"""


@dataclass(frozen=True)
class Protocol:
    """Rules of a comparison.

    Attributes:
        version: Name of the protocol.
        bank: Bank of scenes.
        split: Split of the bank.
        episodes: Number of episodes on each track.
        seed: Seed of the first episode; episode i has the seed ``seed + i``.
        difficulty: Difficulties of the targets, at their natural frequency.
        timeout: Time limit of each call of the agent, seconds.
        start: Start configuration, from which the targets of the bank are rated.
    """

    version: str = "v1"
    bank: str = "default"
    split: str = "test"
    episodes: int = 1000
    seed: int = 0
    difficulty: tuple[str, ...] = ("easy", "medium", "hard")
    timeout: float = 120.0
    start: str = "upright"


V1 = Protocol()
"""The current protocol."""

_DIGITS = 6


class Entry(BaseModel):
    """Leaderboard entry of an agent: protocol, environment and one record per episode.

    Attributes:
        agent: Name of the agent, as `make_agent` takes it.
        note: Free text, such as how it was trained and on how many seeds.
        protocol: The protocol.
        bank_sha256: Checksum of the bank's manifest.
        versions: Versions of the packages that the numbers depend on.
        machine: Properties that times depend on, for each track: ``processor``, ``cores``, ``python``, ``num_envs``
            (parallel episodes in each process) and ``workers`` (processes), with keys such as ``truth: cores``. Keys
            without a track apply to tracks without their own.
        tracks: Values of each field of `greenhouse_gym.evaluation.records.Record` by track, in order.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: Literal[1] = 1
    agent: str
    note: str = ""
    protocol: dict[str, Any]
    bank_sha256: str
    versions: dict[str, str]
    machine: dict[str, str]
    tracks: dict[str, dict[str, list[Any]]]

    def evaluation(self, track: str) -> Evaluation:
        """Return the records of a track as an evaluation."""
        columns = {"measures": [{}] * len(self.tracks[track]["seed"]), **self.tracks[track]}
        rows = zip(*(columns[field.name] for field in fields(Record)), strict=True)
        records = (Record(*row) for row in rows)
        return Evaluation(self.agent, tuple(replace(record, contact=tuple(record.contact)) for record in records))

    def at_once(self, track: str) -> str:
        """Return the number of parallel episodes x processes of a track; "?" where unknown."""
        return " x ".join(self.machine.get(f"{track}: {name}", "?") for name in ("num_envs", "workers"))


def submit(
    agent: Agent,
    name: str,
    out: str | Path,
    tracks: Sequence[str] = tuple(TRACKS),
    protocol: Protocol = V1,
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
        tracks: Names of tracks from `TRACKS`.
        protocol: The protocol.
        num_envs: Number of parallel episodes; only times depend on it.
        note: Free text; empty keeps the note of an existing entry.
        executor: Runs the episodes; see `greenhouse_gym.evaluation.evaluate`.

    Returns:
        Path of the entry.

    Raises:
        InvalidValueError: No track is given, or an unknown one.
        FileFormatError: The existing entry is damaged.
    """
    if not tracks or not set(tracks) <= set(TRACKS):
        raise InvalidValueError(f"tracks must be some of {', '.join(TRACKS)}, got {', '.join(tracks) or 'none'}")
    stem = Path(name).name.replace(":", "-").removesuffix(".json")
    path = Path(out) / (f"{stem}.json" if protocol == V1 else f"{stem}.trial.json")
    fresh = Entry(
        agent=name,
        note=note,
        protocol=_rules_as_json(protocol),
        bank_sha256=SceneBank.open(protocol.bank).sha256,
        versions={package: version(package) for package in ("greenhouse-gym", "mujoco", "numpy")},
        machine={},
        tracks={},
    )
    _merged(path, fresh)  # reports a damaged entry before any episode runs
    about = fresh.model_dump(include={"agent", "protocol", "bank_sha256", "versions"}) | {
        "sha256": _checksum_of(agent, name)
    }
    for track in tracks:
        journal = RecordJournal(path.with_suffix(f".{track}.jsonl"), {**about, "track": track})
        evaluation = _run(agent, protocol, track, protocol.episodes, num_envs, executor, journal)
        entry = _merged(path, fresh)  # other processes may have added tracks
        machine = {f"{track}: {name}": value for name, value in _machine(num_envs, executor).items()}
        changed = {
            "machine": {**entry.machine, **machine},
            "tracks": {**entry.tracks, track: _columns(evaluation.records)},
        }
        write_atomically(path, entry.model_copy(update=changed).model_dump_json() + "\n")
        journal.remove()
    return path


def read_entry(path: str | Path) -> Entry:
    """Read an entry.

    Raises:
        FileFormatError: The file is missing or damaged.
    """
    with parsing(path, "leaderboard entry"):
        return Entry.model_validate_json(read_bytes(path, "leaderboard entry"))


def is_current(entry: Entry) -> bool:
    """Return whether an entry was made on the present version of its bank."""
    return entry.bank_sha256 == SceneBank.open(str(entry.protocol["bank"])).sha256


def follows(entry: Entry, protocol: Protocol = V1) -> bool:
    """Return whether an entry follows a protocol; one that does not follow the current protocol is a trial."""
    return entry.protocol == _rules_as_json(protocol)


def replay(entry: Entry, agent: Agent, track: str, episodes: int = 10) -> list[tuple[Record, Record]]:
    """Repeat the first episodes of an entry and return pairs of its record and the new one."""
    protocol = Protocol(**{**entry.protocol, "difficulty": tuple(entry.protocol["difficulty"])})
    now = _run(agent, protocol, track, episodes).records
    return list(zip(entry.evaluation(track).records[:episodes], now, strict=True))


def leaderboard_table(entries: Sequence[Entry], protocol: Protocol = V1) -> str:
    """Return a Markdown table of entries by track, best first.

    Entries that follow another protocol or were made on another bank are listed below the table.

    Args:
        entries: The entries.
        protocol: Protocol of the ranked entries.
    """
    heads = ["track", "agent", "episodes", "success [95 %]", "collision", "first motion ms", "action ms", "at once"]
    rows = []
    proper = [entry for entry in entries if follows(entry, protocol)]
    ranked = [entry for entry in proper if is_current(entry)]
    for track in TRACKS:
        here = [(entry, entry.evaluation(track)) for entry in ranked if track in entry.tracks]
        for entry, e in sorted(here, key=lambda pair: -pair[1].success_rate):
            low, high = e.success_interval
            rows.append(
                [
                    track,
                    entry.agent,
                    str(len(e.records)),
                    f"{e.success_rate:.1%} [{low:.1%}, {high:.1%}]",
                    f"{e.collision_rate:.1%}",
                    f"{1e3 * (e.median('planning_time') + e.median('action_time')):.1f}",
                    f"{1e3 * e.median('action_time'):.2f}",
                    entry.at_once(track),
                    f"{e.median('steps', solved_only=True):.0f}",
                ]
            )
    table = Table([*heads, "steps"], rows, words=(0, 1)).as_markdown()
    stale = [entry.agent for entry in proper if not is_current(entry)]
    trials = [entry.agent for entry in entries if not follows(entry, protocol)]
    table += f"\nMade on an earlier bank, to be submitted again: {', '.join(stale)}.\n" if stale else ""
    return table + (f"\nTrials that do not follow the current protocol: {', '.join(trials)}.\n" if trials else "")


def _merged(path: Path, fresh: Entry) -> Entry:
    """Return the existing entry if it can hold tracks of the fresh one, else the fresh one."""
    before = read_entry(path) if path.is_file() else fresh
    same = ("agent", "protocol", "bank_sha256", "versions")
    if any(getattr(before, name) != getattr(fresh, name) for name in same):
        return fresh
    return before.model_copy(update={"note": fresh.note or before.note})


def _checksum_of(agent: Agent, name: str) -> str:
    """Return the checksum of the files that define an agent: the source of its class, and the file in its name."""
    files = [Path(name if Path(name).is_file() else name.rpartition(":")[0])]
    with suppress(TypeError):  # a class from a file that was loaded without a module name
        files.append(Path(inspect.getsourcefile(type(agent)) or ""))
    return sha256(b"".join(file.read_bytes() for file in files if file.is_file())).hexdigest()


def _rules_as_json(protocol: Protocol) -> dict[str, Any]:
    rules: dict[str, Any] = json.loads(json.dumps(asdict(protocol)))
    return rules


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
) -> Evaluation:
    options = {"bank": protocol.bank, "difficulty": protocol.difficulty, "start": protocol.start, **TRACKS[track]}
    return evaluate(
        agent,
        protocol.split,
        episodes,
        protocol.seed,
        num_envs=num_envs,
        timeout=protocol.timeout,
        executor=executor,
        journal=journal,
        **options,
    )


def _columns(records: Sequence[Record]) -> dict[str, list[Any]]:
    columns = {field.name: [_plain(getattr(record, field.name)) for record in records] for field in fields(Record)}
    return columns if any(columns["measures"]) else {name: columns[name] for name in columns if name != "measures"}


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, _DIGITS)
    return list(value) if isinstance(value, tuple) else value
