"""Checkpoints of a training: all weights and the optimizer's memory as safetensors, the rest as JSON. No pickles."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel, NonNegativeInt
from safetensors.torch import load, save

from greenhouse_gym.common.files import parsing, read_bytes, write_atomically
from greenhouse_gym.errors import FileFormatError

NAME = "checkpoint.safetensors"


class _Notes(BaseModel):
    steps: NonNegativeInt
    settings: dict[str, Any]


def save_checkpoint(model: Any, folder: Path, notes: dict[str, Any]) -> Path:
    """Write a Stable-Baselines3 model's state, with ``notes`` that JSON can hold, as one file in ``folder``."""
    tensors = {f"policy.{name}": tensor for name, tensor in model.policy.state_dict().items()}
    tensors |= {f"alone.{name}": tensor for name, tensor in _alone(model).items()}
    for kind, optimizer in _optimizers(model).items():
        for index, state in optimizer.state_dict()["state"].items():
            tensors |= {f"{kind}.{index}.{name}": torch.as_tensor(value) for name, value in state.items()}
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
    optimizers = _optimizers(model)
    states = {kind: optimizer.state_dict() for kind, optimizer in optimizers.items()}
    for key, tensor in tensors.items():
        kind, index, name = f"{key}..".split(".")[:3]
        if kind in ("policy", "alone"):
            continue
        shapes = [parameter.shape for parameter in _parameters(optimizers[kind])] if kind in optimizers else []
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
        for name, tensor in _alone(model).items():
            tensor.data.copy_(tensors[f"alone.{name}"])
    except (RuntimeError, ValueError, KeyError) as error:
        raise FileFormatError(path, f"does not fit the network: {error}") from error
    model.num_timesteps = notes["steps"]
    return notes


def _optimizers(model: Any) -> dict[str, torch.optim.Optimizer]:
    """The optimizers of a model: PPO has one, SAC three."""
    policy = model.policy
    if hasattr(policy, "optimizer"):
        return {"optimizer": policy.optimizer}
    return {"actor": policy.actor.optimizer, "critic": policy.critic.optimizer, "entropy": model.ent_coef_optimizer}


def _parameters(optimizer: torch.optim.Optimizer) -> list[torch.Tensor]:
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def _alone(model: Any) -> dict[str, torch.Tensor]:
    """What a model learns beside its policy."""
    return {"log_ent_coef": model.log_ent_coef} if hasattr(model, "log_ent_coef") else {}
