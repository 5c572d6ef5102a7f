"""Shared parts of trainings by PPO and SAC: start or resume, callback, checkpoints, and the policy file."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import fields
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure

from greenhouse_gym.common.files import exclusive, write_atomically
from greenhouse_gym.common.own_code import described
from greenhouse_gym.common.progress import progress
from greenhouse_gym.common.progress import report as say
from greenhouse_gym.errors import FileWriteError, GreenhouseError, InvalidValueError
from greenhouse_gym.evaluation import Evaluation, evaluate
from greenhouse_gym.learning.policies import fits_policy_file, save_policy
from greenhouse_gym.learning.sb3 import TERMS, Sb3Agent
from greenhouse_gym.learning.training_files import (
    CHECKPOINT,
    CURVE,
    VALIDATION,
    algorithm_of,
    check_folder,
    has_diverged,
    load_checkpoint,
    read_curve,
    read_notes,
    save_checkpoint,
    write_curve,
)
from greenhouse_gym.scene import Scene, SceneBank

WINDOW = 10
"""Lines of the learning curve whose episodes each line averages over."""

COLUMNS = ("steps", "seconds", "success_rate", "collision_rate", "return", "length")
"""Columns of the learning curve."""

VALIDATION_SEED = 10_000
"""Seed of the first validation episode."""


class Validation(NamedTuple):
    """Episodes of the policy without its noise, the same ones every time.

    Attributes:
        steps: Environment steps of the training so far.
        updates: Gradient updates since the training began or was resumed.
        seconds: Seconds of the training so far.
        results: The episodes by split.
    """

    steps: int
    updates: int
    seconds: float
    results: Mapping[str, Evaluation]

    def row(self) -> dict[str, float]:
        """Return the line of ``validation.csv``."""
        figures: dict[str, float] = {"steps": self.steps, "updates": self.updates, "seconds": self.seconds}
        for split, result in self.results.items():
            prefix = "" if split == "validation" else f"{split}_"
            figures[f"{prefix}success_rate"] = result.success_rate
            figures[f"{prefix}collision_rate"] = result.collision_rate
        return figures

    def __str__(self) -> str:
        figures = (
            f"{split}: success {result.success_rate:.0%}, collision {result.collision_rate:.0%}"
            for split, result in self.results.items()
        )
        return f"{self.steps:,} steps, {self.seconds:.0f} s; {'; '.join(figures)}"


class TrainingReport(BaseCallback):  # type: ignore[misc]
    """Record a training, save its checkpoints and stop it at its time limit.

    Args:
        out: Folder of the training.
        settings: Settings of the training, as `as_json` returns them.
        model: The model, untrained or resumed.
        curve_steps: Steps per line of the learning curve.
        splits: Splits to validate on, every ``validation_steps`` of the settings; never if these are 0.
        options: Keywords of `evaluate` for the validation.
        time_limit: Seconds after which the training stops, or None.
        checkpoint_seconds: Seconds between checkpoints.
        on_progress: Called with each new line of the learning curve.
        on_validation: Called with each validation.
    """

    def __init__(
        self,
        out: Path,
        settings: Mapping[str, Any],
        model: Any,
        curve_steps: int,
        splits: Sequence[str],
        options: Mapping[str, Any],
        time_limit: float | None,
        checkpoint_seconds: float,
        on_progress: Callable[[Mapping[str, float]], None] = lambda line: None,
        on_validation: Callable[[Validation], None] = lambda validation: None,
    ):
        super().__init__()
        self.out, self.settings, self.model, self.splits, self.options = out, settings, model, splits, options
        self.time_limit, self.checkpoint_seconds = time_limit, checkpoint_seconds
        self.on_progress, self.on_validation = on_progress, on_validation
        self.curve_steps, self.validation_steps = curve_steps, settings["validation_steps"]
        done = model.num_timesteps
        self.rows, self.validations = (
            [row for row in read_curve(out / name) if row["steps"] <= done] if done else []
            for name in (CURVE, VALIDATION)
        )
        self.last_step = done
        self.seconds_before = max((rows[-1]["seconds"] for rows in (self.rows, self.validations) if rows), default=0.0)
        self.began = self.saved = time.monotonic()
        self.episodes: list[list[dict[str, Any]]] = [[]]
        self.note = ""
        self.display = ExitStack()
        self.show = self.display.enter_context(progress("steps of training", settings["total_steps"]))

    def _on_step(self) -> bool:
        self.show(self.num_timesteps, self.note)
        for info in self.locals["infos"]:
            if "episode" in info:
                self.episodes[-1].append(info)
                self.logger.record_mean("episodes/success_rate", float(info["is_success"]))
                self.logger.record_mean("episodes/collision_rate", float(info["collision"]))
                for name, value in info[TERMS].items():
                    self.logger.record_mean(f"reward/{name}", value)
        if self.validation_steps and self._passed(self.validation_steps):
            self._validate()
        if self._passed(self.curve_steps):
            self._add_line()
        self.last_step = self.num_timesteps
        if time.monotonic() - self.saved > self.checkpoint_seconds:
            self.save()
        return self.time_limit is None or time.monotonic() - self.began < self.time_limit

    def _passed(self, interval: int) -> bool:
        """Return whether the last step has reached a multiple of an interval."""
        return bool(self.num_timesteps // interval > self.last_step // interval)

    def _seconds(self) -> float:
        return round(self.seconds_before + time.monotonic() - self.began, 2)

    def _add_line(self) -> None:
        """Add a line to the learning curve and show it."""
        self.episodes = self.episodes[-WINDOW:]
        infos = [info for line in self.episodes for info in line]
        self.episodes.append([])
        row = {
            "steps": self.num_timesteps,
            "seconds": self._seconds(),
            "success_rate": _mean([info["is_success"] for info in infos]),
            "collision_rate": _mean([info["collision"] for info in infos]),
            "return": _mean([info["episode"]["r"] for info in infos]),
            "length": _mean([info["episode"]["l"] for info in infos]),
        }
        self.rows.append(row)
        if infos:
            self.note = f"success {row['success_rate']:.0%}, collision {row['collision_rate']:.0%}"
        self.on_progress(row)
        if has_diverged(self.model):
            self.save()

    def _validate(self) -> None:
        """Run the validation episodes with the policy without its noise."""
        agent, episodes = Sb3Agent(self.model), self.settings["validation_episodes"]
        results = {
            split: evaluate(agent, split, episodes, seed=VALIDATION_SEED, progress=False, **self.options)
            for split in self.splits
        }
        validation = Validation(self.num_timesteps, self.model._n_updates, self._seconds(), results)
        row = validation.row()
        self.validations.append(row)
        for name in list(row)[3:]:
            self.logger.record(f"validation/{name}", row[name])
        write_curve(self.out / VALIDATION, list(row), self.validations)
        say(str(validation))
        self.on_validation(validation)

    def save(self) -> None:
        """Write the checkpoint and the learning curve.

        Raises:
            DivergedError: The model has diverged; the last checkpoint is kept.
        """
        self.saved = time.monotonic()
        save_checkpoint(self.model, self.out, {"settings": dict(self.settings)})
        write_curve(self.out / CURVE, COLUMNS, self.rows)

    def save_policy(self) -> Path:
        """Write the policy file and return its path, or the checkpoint's if a policy file cannot hold the network."""
        notes = {
            "algorithm": algorithm_of(self.model),
            "settings": dict(self.settings),
            "bank_sha256": SceneBank.open(self.settings["bank"]).sha256,
        }
        if fits_policy_file(self.model):
            return save_policy(self.model, self.out / "policy", notes)
        return self.out / CHECKPOINT

    def close(self) -> None:
        """Stop the progress display and close the log."""
        self.display.close()
        self.model.logger.close()


def as_json(settings: Any) -> dict[str, Any]:
    """Return a dataclass of settings as JSON values: without tuples, and with references to own objects."""

    def written(value: Any) -> Any:
        found = value.name if isinstance(value, Scene) else described(value)
        # without its address, so that a resumed training has the same
        return found if found is not value else f"{type(value).__name__} {getattr(value, '__qualname__', '')}".strip()

    return dict(json.loads(json.dumps({f.name: getattr(settings, f.name) for f in fields(settings)}, default=written)))


def check_start(
    out: Path,
    settings: Mapping[str, Any],
    resume: bool,
    time_limit: float | None = None,
    checkpoint_seconds: float = 1.0,
) -> None:
    """Check that a training can start, or resume, in a folder; see `check_folder`.

    Raises:
        InvalidValueError: Besides, a limit is not a number of seconds.
    """
    for name, value in (("time_limit", time_limit), ("checkpoint_seconds", checkpoint_seconds)):
        number = isinstance(value, Real) and not isinstance(value, bool)
        if value is not None and not (number and value >= 0):
            raise InvalidValueError(f"{name} must be seconds from 0 up, got {value!r}")
    check_folder(out / CHECKPOINT, lambda: read_notes(out)["settings"], settings, "total_steps", resume)


@contextmanager
def making_model() -> Iterator[None]:
    """Turn errors of libraries about a network that they cannot make into an `InvalidValueError`."""
    try:
        yield
    except GreenhouseError:
        raise
    except (AssertionError, RuntimeError, ValueError, TypeError, MemoryError) as error:
        raise InvalidValueError(f"Stable-Baselines3 cannot make a model with these settings: {error}") from error


@contextmanager
def training_in(out: Path, model: Any, settings: Mapping[str, Any], resume: bool) -> Iterator[None]:
    """Lock the folder of a training for this process; afterwards close the model's environment.

    The model gets its log and, to resume, the state of the checkpoint; ``settings.json`` is written.

    Raises:
        FileWriteError: Another training is at work in the folder, or it cannot be written.
        InvalidValueError: See `check_folder`.
    """
    try:
        with exclusive(out), writing(out):
            check_start(out, settings, resume)  # another training may have begun since
            model.set_logger(configure(str(out / "tensorboard"), ["tensorboard"]))
            if resume:
                load_checkpoint(model, out)
                model.get_env().seed(settings["seed"] + model.num_timesteps)
            write_atomically(out / "settings.json", json.dumps(settings, indent=1) + "\n")
            yield
    finally:
        model.get_env().close()


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """Turn errors of libraries that write to a folder, for example on a full disk, into a `FileWriteError`.

    TensorBoard's thread raises them in its caller, too; there they need not be shown.
    """
    shown = threading.excepthook
    threading.excepthook = lambda error: None if isinstance(error.exc_value, OSError) else shown(error)
    try:
        yield
    except GreenhouseError:
        raise
    except OSError as error:
        raise FileWriteError(out, error) from error
    finally:
        threading.excepthook = shown


def learn(model: Any, report: TrainingReport, resume: bool, callbacks: Sequence[BaseCallback] = ()) -> Path:
    """Train a model to the end of its steps, and save it, also after an interruption.

    Args:
        model: The model, in `training_in`.
        report: Its callback.
        resume: True if it continues a training.
        callbacks: Further callbacks.

    Returns:
        The path of the policy's JSON file, or of the checkpoint if a policy file cannot hold the network.

    Raises:
        DivergedError: The model has diverged; the last checkpoint is kept.
    """
    remaining = report.settings["total_steps"] - model.num_timesteps
    try:
        if remaining > 0:
            model.learn(remaining, callback=[report, *callbacks], reset_num_timesteps=not resume)
        report.save()
    except KeyboardInterrupt:
        report.save()
        say(f"interrupted after {model.num_timesteps} steps; resume to continue from here")
        report.save_policy()
        raise
    except Exception:
        report.save()  # which raises an error of its own if the model has diverged
        raise
    finally:
        report.close()
    return report.save_policy()


def _mean(values: Sequence[float]) -> float:
    """Return the mean to five decimals; nan without values."""
    return round(float(np.mean(values)), 5) if values else float("nan")
