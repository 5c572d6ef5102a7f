"""Shared parts of trainings by PPO and SAC: start or resume, and train to the end."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from numbers import Real
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure

from greenhouse_gym.common.files import exclusive, write_atomically
from greenhouse_gym.common.own_code import described
from greenhouse_gym.common.progress import report as say
from greenhouse_gym.errors import FileWriteError, GreenhouseError, InvalidValueError
from greenhouse_gym.learning.training_files import (
    CHECKPOINT,
    check_folder,
    load_checkpoint,
    read_notes,
    restart_episodes,
)
from greenhouse_gym.learning.training_report import TrainingReport
from greenhouse_gym.scene import Scene


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
                restart_episodes(model, settings["seed"])
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
