"""Learned policies as agents: a small network in numpy, read from a weights file and a description beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.errors import FileFormatError, InvalidValueError, MissingDependencyError, UnknownNameError
from greenhouse_gym.paths import data_path, write_atomically

Float32 = npt.NDArray[np.float32]

ACTIVATIONS: dict[str, Callable[[Float32], Float32]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, np.float32(0.0)),
}
"""Activations between layers by name."""

_VERSION = 1


@dataclass(frozen=True, eq=False)
class Policy:
    """A multilayer perceptron from observations to actions.

    Attributes:
        weights: Per layer (outputs, inputs).
        biases: Per layer (outputs,).
        activation: One of `ACTIVATIONS`, between layers.
        center: (size,) subtracted from observations.
        scale: (size,) that divides them then.
        env_options: Keywords for `gymnasium.make` that give the environment it was trained for.
        layout: Name and number of entries of each group of the observation.
        training: How it came about: algorithm, settings, steps.
    """

    weights: tuple[Float32, ...]
    biases: tuple[Float32, ...]
    activation: str
    center: Float32
    scale: Float32
    env_options: Mapping[str, Any]
    layout: tuple[tuple[str, int], ...]
    training: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, observations: npt.ArrayLike) -> Float32:
        """Actions in [-1, 1], (joints,) or (n, joints), for observations (size,) or (n, size)."""
        x = np.asarray(observations, dtype=np.float32)
        if x.shape[-1:] != self.center.shape:
            raise InvalidValueError(f"expected observations of {len(self.center)} entries, got shape {x.shape}")
        x = (x - self.center) / self.scale
        activate = ACTIVATIONS[self.activation]
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = activate(np.asarray(x @ weight.T + bias, dtype=np.float32))
        return np.clip(x @ self.weights[-1].T + self.biases[-1], -1.0, 1.0).astype(np.float32)

    def save(self, path: str | Path) -> Path:
        """Write ``path``.safetensors (weights) and then ``path``.json (everything else); returns the latter."""
        path = _stem(path)
        arrays = {"center": self.center, "scale": self.scale}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays[f"layer_{i}.weight"], arrays[f"layer_{i}.bias"] = weight, bias
        contiguous = {name: np.ascontiguousarray(array, dtype=np.float32) for name, array in arrays.items()}
        write_atomically(path.with_name(path.name + ".safetensors"), _safetensors().save(contiguous))
        description = {
            "schema_version": _VERSION,
            "network": {"kind": "mlp", "sizes": self._sizes(), "activation": self.activation},
            "observation_layout": [list(group) for group in self.layout],
            "env_options": dict(self.env_options),
            "training": dict(self.training),
        }
        return write_atomically(path.with_name(path.name + ".json"), json.dumps(description, indent=1) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Policy:
        """Read a policy by its path, with or without a suffix.

        Raises:
            FileFormatError: A file is missing or damaged, or the two do not belong together.
        """
        path = _stem(path)
        described, weighed = (path.with_name(path.name + suffix) for suffix in (".json", ".safetensors"))
        try:
            description = json.loads(described.read_text())
            arrays = _safetensors().load(weighed.read_bytes())
        except OSError as error:
            raise FileFormatError(error.filename or path, f"cannot be read ({error.strerror or error})") from error
        except ValueError as error:
            raise FileFormatError(described, f"is not JSON: {error}") from error
        except Exception as error:  # safetensors raises its own kind
            raise FileFormatError(weighed, f"is not a safetensors file: {error}") from error
        try:
            if description["schema_version"] != _VERSION:
                raise FileFormatError(described, f"schema version {description['schema_version']}, expected {_VERSION}")
            count = len(description["network"]["sizes"]) - 1
            policy = cls(
                weights=tuple(arrays[f"layer_{i}.weight"] for i in range(count)),
                biases=tuple(arrays[f"layer_{i}.bias"] for i in range(count)),
                activation=description["network"]["activation"],
                center=arrays["center"],
                scale=arrays["scale"],
                env_options=description["env_options"],
                layout=tuple((name, size) for name, size in description["observation_layout"]),
                training=description["training"],
            )
        except (KeyError, TypeError) as error:
            raise FileFormatError(described, f"lacks or misuses {error}") from error
        if policy._sizes() != description["network"]["sizes"] or policy.activation not in ACTIVATIONS:
            raise FileFormatError(
                weighed, f"network {policy._sizes()} differs from {description['network']} in {described.name}"
            )
        return policy

    def _sizes(self) -> list[int]:
        return [self.weights[0].shape[1], *(weight.shape[0] for weight in self.weights)]


class PolicyAgent:
    """A learned policy as an `Agent`.

    Attributes:
        name: How it is called in tables.
        env_options: Keywords for `gymnasium.make` that give the environment it needs.
        policy: The network.
    """

    def __init__(self, policy: Policy, name: str = "policy"):
        self.name = name
        self.policy = policy
        self.env_options: Mapping[str, Any] = policy.env_options

    @classmethod
    def load(cls, policy: str | Path) -> PolicyAgent:
        """A shipped policy by name, or any by its path.

        Raises:
            UnknownNameError: Neither a shipped name nor a file.
            FileFormatError: Its files are missing or damaged.
        """
        shipped = {path.stem: path for path in sorted(data_path("policies").glob("*.json"))}
        path = shipped.get(str(policy)) or _stem(policy)
        if not path.with_name(_stem(path).name + ".json").is_file():
            raise UnknownNameError("policy", str(policy), [*shipped, "(or the path of a policy's files)"])
        return cls(Policy.load(path), name=_stem(path).name)

    def reset(self, problem: Problem) -> None:
        """Nothing to prepare: the network has no memory.

        Raises:
            InvalidValueError: The policy was trained for another arm.
        """
        trained_for = Path(self.env_options.get("robot", problem.robot.name)).stem
        if problem.robot.name != trained_for:
            raise InvalidValueError(f"policy {self.name!r} drives {trained_for!r}, got robot {problem.robot.name!r}")

    def act(self, observation: npt.ArrayLike) -> Float32:
        """The most likely action, (joints,), or (n, joints) for observations (n, size)."""
        return self.policy(observation)


def _stem(path: str | Path) -> Path:
    path = Path(path)
    return path.with_suffix("") if path.suffix in (".json", ".safetensors") else path


def _safetensors() -> Any:
    try:
        import safetensors.numpy
    except ImportError as error:
        raise MissingDependencyError("safetensors", "train") from error
    return safetensors.numpy
