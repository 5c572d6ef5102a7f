"""Files in the folder of a training: checkpoints (no pickles) and learning curves."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from pydantic import BaseModel, NonNegativeInt
from safetensors.torch import load, save

from greenhouse_gym.common.files import parsing, read_bytes, write_atomically
from greenhouse_gym.errors import DivergedError, FileFormatError, InvalidValueError

CHECKPOINT, CURVE, VALIDATION = "checkpoint.safetensors", "curve.csv", "validation.csv"
"""Files of a training: its state, the results of its own episodes, and those on rows that it is not trained on."""


Settings = TypeVar("Settings")

MAX_WEIGHT, MAX_LOGARITHM = 1e6, 80.0
"""Largest weight, and largest logarithm of a noise or an entropy coefficient, of a network that has not diverged."""


class _Notes(BaseModel):
    steps: NonNegativeInt
    settings: dict[str, Any]
    algorithm: str = "PPO"
    updates: NonNegativeInt = 0
    lines: list[list[float]] = []


def check_folder(
    marker: Path, read_settings: Callable[[], Mapping[str, Any]], settings: Mapping[str, Any], longer: str, resume: bool
) -> None:
    """Check that a training can start, or resume, in a folder.

    Args:
        marker: File whose presence shows that the folder holds a training.
        read_settings: Reads the settings of that training.
        settings: The settings of the new or resumed training.
        longer: Name of the setting that may change when a training is resumed.
        resume: True to resume the training.

    Raises:
        InvalidValueError: A training would be overwritten, there is nothing to resume, or the settings differ.
    """
    folder = marker.parent
    if not marker.is_file():
        if resume:
            raise InvalidValueError(f"nothing to resume: {folder} holds no {marker.name}")
        if (folder / CURVE).is_file():  # of a trainer that resumes nothing
            raise InvalidValueError(f"{folder} holds a training, which would be lost: choose another folder")
        return
    before = read_settings()
    if not resume:
        raise InvalidValueError(f"{folder} holds a training, which would be lost: resume it, or choose another folder")
    shared = [name for name in settings if name != longer and name in before]  # others are newer than the training
    if different := [name for name in shared if before[name] != settings[name]]:
        raise InvalidValueError(f"the training in {folder} was made with other settings: {', '.join(different)}")


def write_curve(path: Path, columns: Sequence[str], rows: Sequence[dict[str, float]]) -> None:
    """Write a learning curve as a CSV file.

    Args:
        path: The file.
        columns: Names of the figures, in order.
        rows: Figures of each line.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(path, text.getvalue())


def read_curve(path: Path) -> list[dict[str, float]]:
    """Read the lines of a learning curve; none if the file does not exist."""
    if not path.is_file():
        return []
    with path.open() as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


def has_diverged(model: Any) -> bool:
    """Return whether weights of a Stable-Baselines3 model are not finite or explode."""
    tensors = {**dict(model.policy.named_parameters()), **_tensors_outside_policy(model)}
    largest = {name: MAX_LOGARITHM if name.startswith("log_") else MAX_WEIGHT for name in tensors}
    return any(not bool((tensor.detach().abs() <= largest[name]).all()) for name, tensor in tensors.items())


def algorithm_of(model: Any) -> str:
    """Return the name of the algorithm of Stable-Baselines3 that a model has, itself or by its base class."""
    return next(kind.__name__ for kind in type(model).__mro__ if kind.__module__.startswith("stable_baselines3"))


def save_checkpoint(model: Any, folder: Path, notes: dict[str, Any]) -> Path:
    """Write a Stable-Baselines3 model's weights and optimizers, with JSON ``notes``, as one file in ``folder``.

    Raises:
        DivergedError: The model has diverged; an earlier checkpoint is kept.
        FileWriteError: The file could not be written; an earlier checkpoint is kept.
    """
    if has_diverged(model):
        kept = "there is no checkpoint before that"
        if (folder / CHECKPOINT).is_file():
            kept = f"{folder / CHECKPOINT} of {read_notes(folder)['steps']:,} steps is kept, to resume from"
        raise DivergedError(
            f"the training diverged within {model.num_timesteps:,} steps: weights are not finite or explode; {kept}. A "
            "lower learning_rate may help"
        )
    tensors = {f"policy.{name}": tensor for name, tensor in model.policy.state_dict().items()}
    tensors |= {f"alone.{name}": tensor for name, tensor in _tensors_outside_policy(model).items()}
    for kind, optimizer in _optimizers(model).items():
        for index, state in optimizer.state_dict()["state"].items():
            tensors |= {f"{kind}.{index}.{name}": torch.as_tensor(value) for name, value in state.items()}
    contiguous = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    content = save(
        contiguous,
        {
            "notes": json.dumps(
                {
                    "steps": int(model.num_timesteps),
                    "updates": int(model._n_updates),
                    "algorithm": algorithm_of(model),
                    **notes,
                }
            )
        },
    )
    return write_atomically(folder / CHECKPOINT, content)


def read_notes(folder: Path) -> dict[str, Any]:
    """Read the notes of a checkpoint: ``steps``, ``settings``, ``algorithm``, ``updates`` and ``lines`` of episodes.

    Raises:
        FileFormatError: The checkpoint is missing or damaged.
    """
    path = folder / CHECKPOINT
    data = read_bytes(path, "checkpoint")
    with parsing(path, "checkpoint"):
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
        notes = _Notes.model_validate_json(header["__metadata__"]["notes"])
    return notes.model_dump()


def settings_of(folder: Path, kind: type[Settings]) -> Settings:
    """Read the settings of the training in a folder.

    Raises:
        FileFormatError: The checkpoint is missing or damaged, or its settings are not of that kind.
    """
    described = read_notes(folder)["settings"]
    with parsing(folder / CHECKPOINT, f"checkpoint with {kind.__name__}"):
        return kind(**{name: tuple(value) if isinstance(value, list) else value for name, value in described.items()})


def load_checkpoint(model: Any, folder: Path) -> dict[str, Any]:
    """Load a checkpoint's weights, optimizers and step count into a model of the same settings; return its notes.

    Raises:
        FileFormatError: The checkpoint is missing, damaged, or of another network.
    """
    notes, path = read_notes(folder), folder / CHECKPOINT
    with parsing(path, "checkpoint"):
        tensors = load(read_bytes(path, "checkpoint"))
    optimizers = _optimizers(model)
    states = {kind: optimizer.state_dict() for kind, optimizer in optimizers.items()}
    for key, tensor in tensors.items():
        kind, index, name = f"{key}..".split(".")[:3]
        if kind in ("policy", "alone"):
            continue
        shapes = [parameter.shape for parameter in parameters_of(optimizers[kind])] if kind in optimizers else []
        known = index.isdigit() and int(index) < len(shapes)
        if not known or tensor.shape not in (shapes[int(index)], torch.Size([])):
            raise FileFormatError(path, f"does not fit the network: {key} has shape {tuple(tensor.shape)}")
        states[kind]["state"].setdefault(int(index), {})[name] = tensor
    weights = {key.removeprefix("policy."): tensor for key, tensor in tensors.items() if key.startswith("policy.")}
    if flawed := [key for key, tensor in tensors.items() if not torch.isfinite(tensor).all()]:
        raise FileFormatError(path, f"{flawed[0]} has entries that are not finite")
    try:
        model.policy.load_state_dict(weights)
        for kind, optimizer in optimizers.items():
            optimizer.load_state_dict(states[kind])
        for name, tensor in _tensors_outside_policy(model).items():
            tensor.data.copy_(tensors[f"alone.{name}"])
    except (RuntimeError, ValueError, KeyError) as error:
        raise FileFormatError(path, f"does not fit the network: {error}") from error
    model.num_timesteps, model._n_updates = notes["steps"], notes["updates"]
    return notes


def restart_episodes(model: Any, seed: int) -> None:
    """Start new episodes in all simulations, and all random numbers, as the seed and the steps so far decide."""
    model.set_random_seed((seed + model.num_timesteps) % 2**32)
    model._last_obs = model.get_env().reset()
    model._last_episode_starts = np.ones(model.n_envs, bool)


def parameters_of(optimizer: torch.optim.Optimizer) -> list[torch.Tensor]:
    """Return the parameters of an optimizer, in order."""
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def _optimizers(model: Any) -> dict[str, torch.optim.Optimizer]:
    """Return the optimizers of a model: one for PPO, three for SAC."""
    policy = model.policy
    if hasattr(policy, "optimizer"):
        return {"optimizer": policy.optimizer}
    return {"actor": policy.actor.optimizer, "critic": policy.critic.optimizer, "entropy": model.ent_coef_optimizer}


def _tensors_outside_policy(model: Any) -> dict[str, torch.Tensor]:
    """Return the learned tensors that are not part of the policy."""
    return {"log_ent_coef": model.log_ent_coef} if hasattr(model, "log_ent_coef") else {}
