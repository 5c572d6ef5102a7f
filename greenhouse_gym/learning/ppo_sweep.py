"""Trainings by PPO with different settings on any executor, each resumed at its last checkpoint."""

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
from greenhouse_gym.learning.ppo import train_ppo
from greenhouse_gym.learning.settings import PpoSettings
from greenhouse_gym.learning.training_files import CHECKPOINT, CURVE, read_curve

Row = dict[str, Any]
"""A training's varied settings, its folder, and the last line of its learning curve or its error."""

TABLE = "sweep.json"
"""File in the folder of the sweep with the rows of all finished trainings, the best first."""


@dataclass(frozen=True)
class _Training:
    """A training; it can be pickled."""

    name: str
    tried: Mapping[str, Any]
    settings: PpoSettings
    folder: Path


def sweep_ppo(
    settings: PpoSettings,
    choices: Mapping[str, Sequence[Any]],
    out: str | Path,
    executor: Executor | None = None,
    on_result: Callable[[Row, int, int], None] = lambda row, done, of: None,
    *,
    stop_early: bool = False,
    on_progress: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Train with each combination of values of some settings.

    Each training writes its own folder below ``out``, wherever it runs; on a cluster all nodes must see ``out``. A
    training whose process or node is lost continues from its last checkpoint, and so do all when the sweep is started
    again. A training that fails does not affect the others; its row contains the error.

    With a `RayExecutor` the trainings are trials of Ray Tune, which keeps its own files in ``out/tune``.

    Args:
        settings: The settings that all share; each training has one thread unless they say otherwise.
        choices: Values to try, by name of the setting.
        out: Folder of the sweep.
        executor: Where trainings run; None runs them one after the other in this process.
        on_result: Called with the row of each finished training, the number of finished ones, and the total.
        stop_early: True to let Ray Tune stop trainings that fall behind: at an eighth, a quarter and a half of the
            steps, those with a success rate below the median of the trainings that got there before. Their rows
            contain ``stopped_early``.
        on_progress: With a `RayExecutor`, called with a training's row at each line of its curve; otherwise each
            training shows its own progress.

    Returns:
        The rows, the highest success rate first.

    Raises:
        InvalidValueError: Nothing to try, a value twice, a value that the setting does not take, or ``stop_early``
            without a `RayExecutor`.
        UnknownNameError: No such setting.
        FileWriteError: Another process is sweeping in the folder.
        WorkerLostError: A process of the executor died; with a `RayExecutor`, the row of its training reports that
            instead.
        MissingDependencyError: The executor is a `RayExecutor`, and Ray Tune is not installed.
    """
    trainings = _trainings(settings, choices, Path(out))
    if stop_early and not isinstance(executor, RayExecutor):
        raise InvalidValueError(
            "Ray Tune stops trainings that fall behind: stop_early needs a RayExecutor (--backend ray)"
        )
    rows: list[Row] = []

    def add(row: Row) -> None:
        rows.append(row)
        rows.sort(key=lambda row: (-(row.get("success_rate") or 0.0), row["folder"]))
        write_atomically(Path(out) / TABLE, json.dumps(rows, indent=1) + "\n")
        on_result(row, len(rows), len(trainings))

    with exclusive(out):
        if isinstance(executor, RayExecutor):
            _tune(trainings, executor, Path(out), add, on_progress, stop_early)
        else:
            for row in completed(_train, trainings.values(), executor):
                add(row)
    return rows


def _tune(
    trainings: Mapping[str, _Training],
    cluster: RayExecutor,
    out: Path,
    add: Callable[[Row], None],
    on_progress: Callable[[Row], None],
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

    run_trials(_train, trainings, cluster, out, ended, on_progress, halving)


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


def _train(
    training: _Training, on_progress: Callable[[Mapping[str, float], Row], None] = lambda line, row: None
) -> Row:
    """Start or resume a training and return its row; ``on_progress`` gets each line of its curve and the row so far."""
    folder = training.folder
    try:
        if not folder.parent.is_dir():  # made by the head
            raise InvalidValueError(f"node {platform.node()} sees no folder {folder.parent}: all nodes must see it")
        before = read_curve(folder / CURVE)
        for line in before:  # Ray Tune may not know them
            on_progress(line, _row(training, before[-1]))
        if training.settings.total_steps < 1:
            return _row(training)
        try:
            resume = (folder / CHECKPOINT).is_file()

            def report(line: Mapping[str, float]) -> None:
                on_progress(line, _row(training, line))

            train_ppo(training.settings, folder, resume=resume, on_progress=report)
        except GreenhouseError:
            raise
        except Exception as error:  # for example of a distribution whose mean is nan
            return _row(training, error=f"{type(error).__name__}: {error}")
        return _row(training, *read_curve(folder / CURVE)[-1:])
    except GreenhouseError as error:
        return _row(training, error=str(error))


def _row(training: _Training, line: Mapping[str, float] = MappingProxyType({}), **more: Any) -> Row:
    figures = {name: float(value) if isfinite(value) else None for name, value in line.items()}
    return {**training.tried, "folder": training.name, **figures, **more}
