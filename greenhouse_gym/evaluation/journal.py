"""Journal of an evaluation: records are appended as episodes end, so that an interrupted evaluation can resume."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from greenhouse_gym.common.files import read_bytes, write_atomically
from greenhouse_gym.errors import FileFormatError, FileWriteError
from greenhouse_gym.evaluation.records import Record

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
