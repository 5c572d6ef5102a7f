"""Entries of the leaderboard: protocol, environment and one record per episode, in one JSON file."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError, model_validator

from greenhouse_gym.common.files import first_fault, parsing, read_bytes
from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.evaluation.records import Evaluation, Record
from greenhouse_gym.scene import SceneBank


@dataclass(frozen=True)
class Protocol:
    """Rules of a comparison.

    Attributes:
        version: Name of the protocol.
        bank: Bank of scenes.
        split: Split of the bank.
        episodes: Number of episodes on each track; at most `STANDS` on the track "harvest".
        seed: Seed of the first episode; episode i has the seed ``seed + i``.
        difficulty: Difficulties of the targets, at their natural frequency.
        timeout: Time limit of each call of the agent, seconds.
        start: Start configuration, that of the environment by default.
    """

    version: str = "v2"
    bank: str = "default"
    split: str = "test"
    episodes: int = 1000
    seed: int = 0
    difficulty: tuple[str, ...] = ("easy", "medium", "hard")
    timeout: float = 120.0
    start: str = "ready"

    def as_json(self) -> dict[str, Any]:
        """Return the rules as an entry stores them."""
        rules: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return rules

    def episodes_on(self, track: str) -> int:
        """Return the number of episodes on a track: a stand to harvest takes as long as a hundred reaches."""
        return min(self.episodes, STANDS) if track == HARVEST else self.episodes


HARVEST, STANDS = "harvest", 100
"""Track of harvests, and its largest number of stands."""

CURRENT = Protocol()
"""The current protocol."""

_DIGITS = 6
_OPTIONAL = ("measures", "rules")  # fields of records that entries leave out where they are empty
_PROTOCOL, _RECORDS = TypeAdapter(Protocol), TypeAdapter(tuple[Record, ...])


class Entry(BaseModel):
    """Leaderboard entry of an agent: protocol, environment and one record per episode.

    Attributes:
        agent: Name of the agent, as `make_agent` takes it.
        note: Free text, such as how it was trained and on how many seeds.
        protocol: The protocol.
        bank_sha256: Checksum of the bank's manifest.
        knows: What the agent acts on: "scene" if it reads all shapes of the reconstruction, or observes a plan in them,
            "observation" if it acts on measurements around the arm alone.
        action: Kind of action of the episodes, "own" for an object of the agent. Entries from before "tip_velocity"
            became the default do not name it.
        versions: Versions of the packages that the numbers depend on.
        machine: Properties that times depend on, for each track: ``processor``, ``cores``, ``python``, ``num_envs``
            (parallel episodes in each process) and ``workers`` (processes), with keys such as ``truth: cores``. Keys
            without a track apply to tracks without their own.
        tracks: Values of each field of `greenhouse_gym.evaluation.records.Record` by track, in order; fields that are
            empty in all records may be left out.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: Literal[1] = 1
    agent: str
    note: str = ""
    protocol: dict[str, Any]
    bank_sha256: str
    knows: Literal["scene", "observation"] = "scene"
    action: str = "joint"
    versions: dict[str, str]
    machine: dict[str, str]
    tracks: dict[str, dict[str, list[Any]]]

    @model_validator(mode="after")
    def _is_whole(self) -> Entry:
        rules = self.rules
        for track in self.tracks:
            records, episodes = self.evaluation(track).records, rules.episodes_on(track)
            if len(records) != episodes:
                raise InvalidValueError(f"track {track!r} has {len(records)} records, the protocol {episodes} episodes")
            for seed, record in enumerate(records, rules.seed):
                if record.seed != seed:
                    raise InvalidValueError(f"track {track!r}: expected the episode of seed {seed}, got {record.seed}")
                for name in ("steps", "planning_time", "action_time"):
                    if not 0 <= getattr(record, name) <= sys.maxsize:
                        value = f"{getattr(record, name)!r:.40}"
                        raise InvalidValueError(f"track {track!r}, seed {seed}: {name} must be from 0 up, got {value}")
            if changed := next((record.rules for record in records if record.rules), ""):
                raise InvalidValueError(f"track {track!r} has episodes under other rules: {changed}")
        return self

    @property
    def rules(self) -> Protocol:
        """The protocol; rules that the entry does not name are the current ones."""
        return _PROTOCOL.validate_python(self.protocol)

    def evaluation(self, track: str) -> Evaluation:
        """Return the records of a track as an evaluation.

        Raises:
            UnknownNameError: The entry has no such track.
            InvalidValueError: The values of the track are damaged.
        """
        columns = self.tracks[require_choice("track", track, self.tracks)]
        if unknown := columns.keys() - {field.name for field in fields(Record)}:
            raise InvalidValueError(f"track {track!r}: records have no {', '.join(sorted(unknown))}")
        counts = {name: len(values) for name, values in columns.items()}
        if len(set(counts.values())) > 1:
            raise InvalidValueError(f"track {track!r}: each record needs one value of each kind, got {counts}")
        rows = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
        try:
            return Evaluation(self.agent, _RECORDS.validate_json(json.dumps(rows), strict=True))
        except ValidationError as error:
            raise InvalidValueError(f"track {track!r}, record {first_fault(error)}") from error

    def at_once(self, track: str) -> str:
        """Return the number of parallel episodes x processes of a track; "?" where unknown."""
        return " x ".join(self.machine.get(f"{track}: {name}", "?") for name in ("num_envs", "workers"))


def read_entry(path: str | Path) -> Entry:
    """Read an entry.

    Raises:
        FileFormatError: The file is missing or damaged.
    """
    with parsing(path, "leaderboard entry"):
        return Entry.model_validate_json(read_bytes(path, "leaderboard entry"))


def is_current(entry: Entry) -> bool:
    """Return whether an entry was made on the present version of its bank."""
    return entry.bank_sha256 == SceneBank.open(entry.rules.bank).sha256


def follows(entry: Entry, protocol: Protocol = CURRENT) -> bool:
    """Return whether an entry follows a protocol; one that does not follow the current protocol is a trial."""
    return entry.protocol == protocol.as_json()


def columns_of(records: Sequence[Record]) -> dict[str, list[Any]]:
    """Return the values of each field of records, as an entry stores them."""
    columns = {field.name: [_plain(getattr(record, field.name)) for record in records] for field in fields(Record)}
    return {name: values for name, values in columns.items() if name not in _OPTIONAL or any(values)}


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, _DIGITS)
    return list(value) if isinstance(value, tuple) else value
