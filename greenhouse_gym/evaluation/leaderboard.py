"""A comparison under frozen rules, kept as files that anyone can check: entries, their table, and their replay."""

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
from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.envs.randomization import Randomization
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation.journal import KeptRecords
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
"""What is touched, beside what is told: the reconstruction itself, the true row, or that after the plants moved."""


@dataclass(frozen=True)
class Protocol:
    """The rules of a comparison.

    Attributes:
        version: Their name.
        bank: The bank of scenes.
        split: Its split.
        episodes: How many, on each track.
        seed: Seed of the first episode; episode i has the seed ``seed + i``.
        difficulty: Difficulties of the targets, as frequent as the scenes have them.
        patience: Seconds an agent may take for one answer.
    """

    version: str = "v1"
    bank: str = "default"
    split: str = "test"
    episodes: int = 1000
    seed: int = 0
    difficulty: tuple[str, ...] = ("easy", "medium", "hard")
    patience: float = 120.0


V1 = Protocol()
"""The rules in force."""

_DIGITS = 6


class Entry(BaseModel):
    """An agent's entry: the rules, what it ran on, and a record per episode.

    Attributes:
        agent: Its name, as `make_agent` takes it.
        note: What else there is to say, such as how it was trained and on how many seeds.
        protocol: The rules.
        bank_sha256: Checksum of the bank's manifest.
        versions: Versions of the packages that decide the numbers.
        machine: What times depend on, for each track: ``processor``, ``cores``, ``python``, ``num_envs`` (episodes side
            by side in each process) and ``workers`` (processes), by names such as ``truth: cores``. Names without a
            track are for those tracks that have none of their own.
        tracks: Per track, the values of each field of `greenhouse_gym.evaluation.records.Record`, in order.
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
        """The records of a track."""
        columns = self.tracks[track]
        rows = zip(*(columns[field.name] for field in fields(Record)), strict=True)
        records = (Record(*row) for row in rows)
        return Evaluation(self.agent, tuple(replace(record, contact=tuple(record.contact)) for record in records))

    def at_once(self, track: str) -> str:
        """How many episodes of a track were played side by side, x in how many processes; "?" if nobody told."""
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
    """Play the episodes of a protocol and write the entry, after each track what there is by then.

    Other tracks of an entry that is there already are kept, if it is of the same agent, rules, bank and versions. Each
    record is kept beside it, in ``NAME.TRACK.jsonl``, until its track is whole: what was interrupted goes on there.

    Args:
        agent: The agent.
        name: What `make_agent` makes it from; the file is called after it, ``NAME.trial.json`` where the rules are not
            those in force.
        out: Folder of the entries.
        tracks: Names of tracks, of `TRACKS`.
        protocol: The rules.
        num_envs: Episodes played side by side; only times depend on it.
        note: What else there is to say; if nothing, what was said with the tracks that are kept.
        executor: Where the episodes are played, as `greenhouse_gym.evaluation.evaluate` has it.

    Returns:
        The entry's file.

    Raises:
        InvalidValueError: No track, or an unknown one.
        FileFormatError: The entry that is there already is damaged.
    """
    if not tracks or not set(tracks) <= set(TRACKS):
        raise InvalidValueError(f"tracks must be some of {', '.join(TRACKS)}, got {', '.join(tracks) or 'none'}")
    called = Path(name).name.replace(":", "-").removesuffix(".json")
    path = Path(out) / (f"{called}.json" if protocol == V1 else f"{called}.trial.json")
    fresh = Entry(
        agent=name,
        note=note,
        protocol=_plain_rules(protocol),
        bank_sha256=SceneBank.open(protocol.bank).sha256,
        versions={package: version(package) for package in ("greenhouse-gym", "mujoco", "numpy")},
        machine={},
        tracks={},
    )
    _kept(path, fresh)  # where it is damaged, that is told before anything is played
    about = fresh.model_dump(include={"agent", "protocol", "bank_sha256", "versions"}) | {
        "sha256": _checksum_of(agent, name)
    }
    for track in tracks:
        kept = KeptRecords(path.with_suffix(f".{track}.jsonl"), {**about, "track": track})
        played = _play(agent, protocol, track, protocol.episodes, num_envs, executor, kept)
        entry = _kept(path, fresh)  # which others may have added tracks to meanwhile
        machine = {f"{track}: {name}": value for name, value in _machine(num_envs, executor).items()}
        changed = {
            "machine": {**entry.machine, **machine},
            "tracks": {**entry.tracks, track: _columns(played.records)},
        }
        write_atomically(path, entry.model_copy(update=changed).model_dump_json() + "\n")
        kept.remove()
    return path


def read_entry(path: str | Path) -> Entry:
    """An entry from its file.

    Raises:
        FileFormatError: It is missing or damaged.
    """
    with parsing(path, "leaderboard entry"):
        return Entry.model_validate_json(read_bytes(path, "leaderboard entry"))


def is_current(entry: Entry) -> bool:
    """Whether the bank is still the one that an entry was played on."""
    return entry.bank_sha256 == SceneBank.open(str(entry.protocol["bank"])).sha256


def follows(entry: Entry, protocol: Protocol = V1) -> bool:
    """Whether an entry was played by some rules; one that was not by those in force is a trial."""
    return entry.protocol == _plain_rules(protocol)


def replay(entry: Entry, agent: Agent, track: str, episodes: int = 10) -> list[tuple[Record, Record]]:
    """Play an entry's first episodes again: pairs of the record that it has and the one that comes out now."""
    protocol = Protocol(**{**entry.protocol, "difficulty": tuple(entry.protocol["difficulty"])})
    now = _play(agent, protocol, track, episodes).records
    return list(zip(entry.evaluation(track).records[:episodes], now, strict=True))


def leaderboard_table(entries: Sequence[Entry], protocol: Protocol = V1) -> str:
    """A Markdown table of entries, track by track, the best on each first.

    Entries by other rules, and those of another bank, are named below it.

    Args:
        entries: The entries.
        protocol: The rules of those that are ranked.
    """
    heads = ["track", "agent", "episodes", "success [95 %]", "collision", "first motion ms", "action ms", "at once"]
    heads.append("steps")
    rows = [heads, ["---", "---"] + ["---:"] * (len(heads) - 2)]
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
    table = "".join("| " + " | ".join(row) + " |\n" for row in rows)
    stale = [entry.agent for entry in proper if not is_current(entry)]
    trials = [entry.agent for entry in entries if not follows(entry, protocol)]
    table += f"\nPlayed on an earlier bank, to be submitted again: {', '.join(stale)}.\n" if stale else ""
    return table + (f"\nTrials, by other rules than those in force: {', '.join(trials)}.\n" if trials else "")


def _kept(path: Path, fresh: Entry) -> Entry:
    """The entry that is there already, if further tracks of a fresh one can stand in it; else the fresh one."""
    before = read_entry(path) if path.is_file() else fresh
    same = ("agent", "protocol", "bank_sha256", "versions")
    if any(getattr(before, name) != getattr(fresh, name) for name in same):
        return fresh
    return before.model_copy(update={"note": fresh.note or before.note})


def _checksum_of(agent: Agent, name: str) -> str:
    """Checksum of the files that an agent is made from: that of its class, and the one it is called by."""
    files = [Path(name if Path(name).is_file() else name.rpartition(":")[0])]
    with suppress(TypeError):  # the class of a file that was loaded under no name
        files.append(Path(inspect.getsourcefile(type(agent)) or ""))
    return sha256(b"".join(file.read_bytes() for file in files if file.is_file())).hexdigest()


def _plain_rules(protocol: Protocol) -> dict[str, Any]:
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


def _play(
    agent: Agent,
    protocol: Protocol,
    track: str,
    episodes: int,
    num_envs: int = 1,
    executor: Executor | None = None,
    kept: KeptRecords | None = None,
) -> Evaluation:
    options = {"bank": protocol.bank, "difficulty": protocol.difficulty, **TRACKS[track]}
    return evaluate(
        agent,
        protocol.split,
        episodes,
        protocol.seed,
        num_envs=num_envs,
        patience=protocol.patience,
        executor=executor,
        kept=kept,
        **options,
    )


def _columns(records: Sequence[Record]) -> dict[str, list[Any]]:
    return {field.name: [_plain(getattr(record, field.name)) for record in records] for field in fields(Record)}


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, _DIGITS)
    return list(value) if isinstance(value, tuple) else value
