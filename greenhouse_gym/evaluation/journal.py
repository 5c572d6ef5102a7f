"""Records of an evaluation, kept in a file as they come, so that one that was interrupted can go on."""

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
    """Records in a file: lines of JSON, first what they are of, then each record with its index among the episodes.

    Args:
        path: The file. Where it holds records of something else, it is begun anew.
        about: What the records are of: all that decides them.

    Attributes:
        records: The records that there are, by their indices.

    Raises:
        FileFormatError: A line of the file, and not only the last one, is damaged.
    """

    def __init__(self, path: str | Path, about: Mapping[str, Any]):
        self._path, self.records = Path(path), dict[int, Record]()
        header = json.dumps({"schema_version": 1, **about}, sort_keys=True)
        lines = read_bytes(path, "kept records").decode(errors="replace").split("\n") if self._path.exists() else []
        if lines[:1] == [header]:
            whole = lines[1:-1]  # the interruption fell into what is behind the last line break
            self.records = dict(self._parsed(line, number) for number, line in enumerate(whole, 2))
        else:
            whole = []
        write_atomically(self._path, "\n".join([header, *whole]) + "\n")

    def add(self, index: int, record: Record) -> None:
        """Keep a record.

        Raises:
            FileWriteError: It cannot be written.
        """
        self.records[index] = record
        try:
            with self._path.open("a") as file:
                file.write(json.dumps({"index": index, **asdict(record)}) + "\n")
        except OSError as error:
            raise FileWriteError(self._path, error) from error

    def remove(self) -> None:
        """Remove the file, once the records stand elsewhere."""
        self._path.unlink(missing_ok=True)

    def _parsed(self, line: str, number: int) -> tuple[int, Record]:
        try:
            content = json.loads(line)
            return int(content.pop("index")), _RECORD.validate_python(content)
        except (ValueError, KeyError, TypeError, AttributeError, ValidationError) as error:
            raise FileFormatError(
                self._path, f"line {number} is no record ({error}); remove the file to play all episodes anew"
            ) from error
