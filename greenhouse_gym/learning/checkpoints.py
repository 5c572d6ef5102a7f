"""Checkpoints of a training: all weights and the optimizer's memory as safetensors, the rest as JSON. No pickles."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel, NonNegativeInt
from safetensors.torch import load, save

from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.paths import parsing, read_bytes, write_atomically

NAME = "checkpoint.safetensors"


class _Notes(BaseModel):
    steps: NonNegativeInt
    settings: dict[str, Any]


def save_checkpoint(model: Any, folder: Path, notes: dict[str, Any]) -> Path:
    """Write a Stable-Baselines3 model's state, with ``notes`` that JSON can hold, as one file in ``folder``."""
    tensors = {f"policy.{name}": tensor for name, tensor in model.policy.state_dict().items()}
    for index, state in model.policy.optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{name}": torch.as_tensor(value) for name, value in state.items()}
    contiguous = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    content = save(contiguous, {"notes": json.dumps({"steps": int(model.num_timesteps), **notes})})
    return write_atomically(folder / NAME, content)


def read_notes(folder: Path) -> dict[str, Any]:
    """The notes of a checkpoint: ``steps``, ``settings``.

    Raises:
        FileFormatError: There is no checkpoint, or it is damaged.
    """
    path = folder / NAME
    data = read_bytes(path, "checkpoint")
    with parsing(path, "checkpoint"):
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
        notes = _Notes.model_validate_json(header["__metadata__"]["notes"])
    return notes.model_dump()


def load_checkpoint(model: Any, folder: Path) -> dict[str, Any]:
    """Put a checkpoint's weights, optimizer and step count into a model of the same settings; returns the notes.

    Raises:
        FileFormatError: There is no checkpoint, it is damaged, or it is of another network.
    """
    notes, path = read_notes(folder), folder / NAME
    with parsing(path, "checkpoint"):
        tensors = load(read_bytes(path, "checkpoint"))
    optimizer = model.policy.optimizer.state_dict()
    shapes = {i: parameter.shape for i, parameter in enumerate(model.policy.parameters())}
    for key, tensor in tensors.items():
        if key.startswith("optimizer."):
            _, index, name = f"{key}..".split(".")[:3]
            if not index.isdigit() or tensor.shape not in (shapes.get(int(index)), torch.Size([])):
                raise FileFormatError(path, f"does not fit the network: {key} has shape {tuple(tensor.shape)}")
            optimizer["state"].setdefault(int(index), {})[name] = tensor
    weights = {key.removeprefix("policy."): tensor for key, tensor in tensors.items() if key.startswith("policy.")}
    if flawed := [key for key, tensor in tensors.items() if not torch.isfinite(tensor).all()]:
        raise FileFormatError(path, f"{flawed[0]} has entries that are not finite")
    try:
        model.policy.load_state_dict(weights)
        model.policy.optimizer.load_state_dict(optimizer)
    except (RuntimeError, ValueError) as error:
        raise FileFormatError(path, f"does not fit the network: {error}") from error
    model.num_timesteps = notes["steps"]
    return notes
