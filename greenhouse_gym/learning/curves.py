"""Learning curves: tables in the folder of a training, with a line each time something is told of it."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from greenhouse_gym.common.files import write_atomically

CURVE, VALIDATION = "curve.csv", "validation.csv"
"""Files of a training: how its own episodes went, and those on rows that it does not train on."""


def write_curve(path: Path, columns: Sequence[str], rows: Sequence[dict[str, float]]) -> None:
    """Write all lines of a learning curve.

    Args:
        path: The file.
        columns: Names of the figures, in their order.
        rows: The figures of each line.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(path, text.getvalue())


def read_curve(path: Path) -> list[dict[str, float]]:
    """The lines of a learning curve; none where there is no file yet."""
    if not path.is_file():
        return []
    with path.open() as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
