"""Several trainings with different settings, spread over any executor, each resumed where it stopped."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import product
from math import isfinite
from pathlib import Path
from typing import Any

from greenhouse_gym.errors import GreenhouseError, InvalidValueError
from greenhouse_gym.learning.checkpoints import NAME as CHECKPOINT
from greenhouse_gym.learning.curves import CURVE, read_curve
from greenhouse_gym.learning.ppo import PpoSettings, train_ppo
from greenhouse_gym.parallel import completed
from greenhouse_gym.paths import exclusive, write_atomically
from greenhouse_gym.settings_files import replaced

Row = dict[str, Any]
"""What was tried in a training, its folder, and the last line of its learning curve or the error that ended it."""

TABLE = "sweep.json"
"""The rows of all trainings that are done, the best first; in the folder of the sweep."""


@dataclass(frozen=True)
class _Training:
    """A training; it can travel."""

    name: str
    tried: Mapping[str, Any]
    settings: PpoSettings
    folder: Path


def sweep_ppo(
    settings: PpoSettings,
    choices: Mapping[str, Sequence[Any]],
    out: str | Path,
    executor: Executor | None = None,
    on_training: Callable[[Row, int, int], None] = lambda row, done, of: None,
) -> list[Row]:
    """Train with each combination of values of some settings.

    Each training has a folder of its own below ``out``, which it writes itself, wherever it runs: with a cluster,
    ``out`` is a folder that all nodes see. A training whose process or node is lost goes on from its last checkpoint,
    and so does everything when the same sweep is begun again. One that fails leaves the others alone.

    Args:
        settings: The settings that all share; each training has one thread unless they say otherwise.
        choices: Values to try, by the name of the setting.
        out: Folder of the sweep.
        executor: Where trainings run; None runs one after the other here.
        on_training: Told the row of each training that is done, how many are, and of how many.

    Returns:
        The rows, the highest success rate first.

    Raises:
        InvalidValueError: Nothing to try, a value twice, or one that the setting does not take.
        UnknownNameError: There is no such setting.
        FileWriteError: Another process is sweeping in the folder.
        WorkerLostError: A process of the executor died.
    """
    trainings = _trainings(settings, choices, Path(out))
    rows: list[Row] = []
    with exclusive(out):
        for done, row in enumerate(completed(_train, trainings, executor), 1):
            rows.append(row)
            rows.sort(key=lambda row: (-(row.get("success_rate") or 0.0), row["folder"]))
            write_atomically(Path(out) / TABLE, json.dumps(rows, indent=1) + "\n")
            on_training(row, done, len(trainings))
    return rows


def _trainings(settings: PpoSettings, choices: Mapping[str, Sequence[Any]], out: Path) -> list[_Training]:
    if not choices or not all(choices.values()):
        raise InvalidValueError(f"a sweep needs settings with values to try, got {dict(choices)}")
    shared = replace(settings, threads=settings.threads or 1)
    trainings: dict[str, _Training] = {}
    for values in product(*choices.values()):
        tried = dict(zip(choices, values, strict=True))
        name = re.sub(r"[^\w.+=,-]+", "_", ",".join(f"{key}={value}" for key, value in tried.items()))
        if name in trainings:
            raise InvalidValueError(f"{tried} is tried twice")
        trainings[name] = _Training(name, tried, replaced(shared, tried), out.resolve() / name)
    return list(trainings.values())


def _train(training: _Training) -> Row:
    row: Row = {**training.tried, "folder": training.name}
    try:
        train_ppo(training.settings, training.folder, resume=(training.folder / CHECKPOINT).is_file())
        last = read_curve(training.folder / CURVE)[-1:]
    except GreenhouseError as error:
        return {**row, "error": str(error)}
    return {**row, **{name: value if isfinite(value) else None for line in last for name, value in line.items()}}
