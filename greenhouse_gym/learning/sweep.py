"""Several trainings with different settings, spread over any executor, each resumed where it stopped."""

from __future__ import annotations

import json
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import product
from math import isfinite
from pathlib import Path
from types import MappingProxyType
from typing import Any

from greenhouse_gym.common.executors import RayExecutor, WorkerLostError, completed
from greenhouse_gym.common.files import exclusive, write_atomically
from greenhouse_gym.common.settings_files import replaced
from greenhouse_gym.errors import GreenhouseError, InvalidValueError
from greenhouse_gym.learning.checkpoints import NAME as CHECKPOINT
from greenhouse_gym.learning.curves import CURVE, read_curve
from greenhouse_gym.learning.ppo import PpoSettings, train_ppo

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
    *,
    stop_early: bool = False,
    on_line: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Train with each combination of values of some settings.

    Each training has a folder of its own below ``out``, which it writes itself, wherever it runs: with a cluster,
    ``out`` is a folder that all nodes see. A training whose process or node is lost goes on from its last checkpoint,
    and so does everything when the same sweep is begun again. One that fails, by whatever error, leaves the others
    alone, and its row says why.

    With a `RayExecutor` the trainings are trials of Ray Tune, which keeps its own files in ``out/tune``.

    Args:
        settings: The settings that all share; each training has one thread unless they say otherwise.
        choices: Values to try, by the name of the setting.
        out: Folder of the sweep.
        executor: Where trainings run; None runs one after the other here.
        on_training: Told the row of each training that is done, how many are, and of how many.
        stop_early: Have Ray Tune end trainings that fall behind: at an eighth, a quarter and a half of the steps, those
            whose success rate is below the median of the trainings that came there before. Their rows are those of the
            steps they got, and say ``stopped_early``.
        on_line: With a `RayExecutor`, told the row that a training has so far with each line of its learning curve;
            elsewhere each training shows its own progress.

    Returns:
        The rows, the highest success rate first.

    Raises:
        InvalidValueError: Nothing to try, a value twice, one that the setting does not take, or trainings to stop early
            without a `RayExecutor`.
        UnknownNameError: There is no such setting.
        FileWriteError: Another process is sweeping in the folder.
        WorkerLostError: A process of the executor died; with a `RayExecutor` the row of its training says so instead.
        MissingDependencyError: The executor is a `RayExecutor`, and Ray Tune is not installed.
    """
    trainings = _trainings(settings, choices, Path(out))
    if stop_early and not isinstance(executor, RayExecutor):
        raise InvalidValueError(
            "trainings that fall behind are stopped by Ray Tune: stop_early needs a RayExecutor (--backend ray)"
        )
    rows: list[Row] = []

    def add(row: Row) -> None:
        rows.append(row)
        rows.sort(key=lambda row: (-(row.get("success_rate") or 0.0), row["folder"]))
        write_atomically(Path(out) / TABLE, json.dumps(rows, indent=1) + "\n")
        on_training(row, len(rows), len(trainings))

    with exclusive(out):
        if isinstance(executor, RayExecutor):
            _tune(trainings, executor, Path(out), add, on_line, stop_early)
        else:
            for row in completed(_train, trainings.values(), executor):
                add(row)
    return rows


def _tune(
    trainings: Mapping[str, _Training],
    cluster: RayExecutor,
    out: Path,
    add: Callable[[Row], None],
    on_line: Callable[[Row], None],
    stop_early: bool,
) -> None:
    from greenhouse_gym.common.executors.ray_tune import Halving, run_trials

    whole = max(training.settings.total_steps for training in trainings.values())
    halving = Halving("success_rate", "steps", whole) if stop_early else None

    def ended(name: str, row: Row | WorkerLostError, early: bool) -> None:
        if isinstance(row, WorkerLostError):
            row = _row(trainings[name], error=str(row))
        unfinished = early and row["steps"] < trainings[name].settings.total_steps
        add({**row, "stopped_early": True} if unfinished else row)

    run_trials(_train, trainings, cluster, out, ended, on_line, halving)


def _trainings(settings: PpoSettings, choices: Mapping[str, Sequence[Any]], out: Path) -> dict[str, _Training]:
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
    return trainings


def _train(training: _Training, tell: Callable[[Mapping[str, float], Row], None] = lambda line, row: None) -> Row:
    """Train, or go on, and give the row; each line of the curve is told with the row that the training has by then."""
    folder = training.folder
    try:
        if not folder.parent.is_dir():  # which the head has made
            raise InvalidValueError(
                f"node {platform.node()} sees no folder {folder.parent}: all nodes must see the same"
            )
        before = read_curve(folder / CURVE)
        for line in before:  # which those who compare trainings have not seen, or have forgotten
            tell(line, _row(training, before[-1]))
        try:
            resume = (folder / CHECKPOINT).is_file()
            train_ppo(training.settings, folder, resume=resume, on_line=lambda line: tell(line, _row(training, line)))
        except GreenhouseError:
            raise
        except Exception as error:  # such as that of a distribution whose mean has come to be no number
            return _row(training, error=f"{type(error).__name__}: {error}")
        return _row(training, *read_curve(folder / CURVE)[-1:])
    except GreenhouseError as error:
        return _row(training, error=str(error))


def _row(training: _Training, line: Mapping[str, float] = MappingProxyType({}), **more: Any) -> Row:
    figures = {name: float(value) if isfinite(value) else None for name, value in line.items()}
    return {**training.tried, "folder": training.name, **figures, **more}
