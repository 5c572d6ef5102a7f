"""Journal of an evaluation: records are appended as episodes end, so that an interrupted evaluation can resume."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from greenhouse_gym.agents import Agent
from greenhouse_gym.common.files import read_bytes, write_atomically
from greenhouse_gym.common.own_code import portable
from greenhouse_gym.errors import FileFormatError, FileWriteError
from greenhouse_gym.evaluation.records import Record
from greenhouse_gym.scene import SceneBank

_RECORD = TypeAdapter(Record)


class RecordJournal:
    """JSON Lines journal of episode records.

    The first line identifies the evaluation; each further line holds one record and its episode index.

    Args:
        path: The file. If it belongs to another evaluation, it is overwritten.
        about: Identifies the evaluation: everything that the records depend on.

    Attributes:
        records: The records by episode index.

    Raises:
        FileFormatError: A complete line of the file is damaged.
    """

    def __init__(self, path: str | Path, about: Mapping[str, Any]):
        self._path, self.records = Path(path), dict[int, Record]()
        header = json.dumps({"schema_version": 1, **about}, sort_keys=True)
        lines = read_bytes(path, "record journal").decode(errors="replace").split("\n") if self._path.exists() else []
        complete = []
        if lines[:1] == [header]:
            complete = lines[1:-1]  # an interrupted write leaves a last line without a line break
            self.records = dict(self._parsed(line, number) for number, line in enumerate(complete, 2))
        write_atomically(self._path, "\n".join([header, *complete]) + "\n")

    def add(self, index: int, record: Record) -> None:
        """Append the record of an episode.

        Raises:
            FileWriteError: The file cannot be written.
        """
        self.records[index] = record
        try:
            with self._path.open("a") as file:
                file.write(json.dumps({"index": index, **asdict(record)}) + "\n")
        except OSError as error:
            raise FileWriteError(self._path, error) from error

    def remove(self) -> None:
        """Delete the file, once its records are stored elsewhere."""
        self._path.unlink(missing_ok=True)

    def _parsed(self, line: str, number: int) -> tuple[int, Record]:
        try:
            content = json.loads(line)
            return int(content.pop("index")), _RECORD.validate_python(content)
        except (ValueError, KeyError, TypeError, AttributeError, ValidationError) as error:
            raise FileFormatError(
                self._path, f"line {number} is not a record ({error}); remove the file to run all episodes again"
            ) from error


def journal_in(folder: Path, agent: Agent, name: str, bank: str, **options: Any) -> RecordJournal:
    """Return the journal of an evaluation in a folder of journals, each named by its identity.

    Args:
        folder: The folder.
        agent: The agent.
        name: Name of the agent, as `make_agent` takes it.
        bank: Name or folder of the bank.
        **options: All else that the records depend on.

    Raises:
        InvalidValueError: An option cannot be written to a file.
    """
    named = [str(value) for value in options.values()]
    about = {
        "agent": name,
        "sha256": [checksum_of(agent, name), *map(_checksum, named)],
        "bank_sha256": SceneBank.open(bank).sha256,
        "versions": package_versions(),
        "options": options,
    }
    content = json.dumps(about, sort_keys=True, default=lambda own: portable(own, "an option"))
    return RecordJournal(folder / f"{sha256(content.encode()).hexdigest()[:16]}.jsonl", json.loads(content))


def checksum_of(agent: Agent, name: str) -> str:
    """Return the checksum of the files that define an agent: the source of its class, and the file in its name."""
    source = ""
    with suppress(TypeError):  # a class from a file that was loaded without a module name
        source = inspect.getsourcefile(type(agent)) or ""
    return _checksum(name, source)


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that records depend on."""
    return {package: version(package) for package in ("greenhouse-gym", "mujoco", "numpy")}


def _checksum(*names: str) -> str:
    """Return the checksum of the files among paths and names such as ``file.py:Name``, with the weights of policies."""
    files: list[Path] = []
    for place in (Path(name if Path(name).exists() else name.rpartition(":")[0] or name) for name in names):
        if place.name:
            files += [place, place.with_suffix(".json"), place.with_suffix(".safetensors")]
            files += sorted(place.glob("*.safetensors"))
    return sha256(b"".join(file.read_bytes() for file in files if file.is_file())).hexdigest()
