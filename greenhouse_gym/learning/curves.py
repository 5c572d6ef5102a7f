"""Learning curves: ``curve.csv`` in the folder of a training, one line each time something is told of it."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from greenhouse_gym.paths import write_atomically

NAME = "curve.csv"


def write_curve(folder: Path, columns: Sequence[str], rows: Sequence[dict[str, float]]) -> None:
    """Write all lines of a learning curve.

    Args:
        folder: The training's folder.
        columns: Names of the figures, in their order.
        rows: The figures of each line.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(folder / NAME, text.getvalue())


def read_curve(folder: Path) -> list[dict[str, float]]:
    """The lines of the learning curve in a training's folder; none where there is none yet."""
    path = folder / NAME
    if not path.is_file():
        return []
    with path.open() as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
