"""Policy networks, stored as a weights file and a JSON description."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PositiveInt, ValidationError

from greenhouse_gym.agents import goal_features, goal_inputs
from greenhouse_gym.common.files import first_fault, parsing, read_bytes, write_atomically
from greenhouse_gym.envs import EnvSettings
from greenhouse_gym.errors import FileFormatError, InvalidValueError, MissingDependencyError

Float32 = npt.NDArray[np.float32]

_HIDDEN: Mapping[str, Callable[[Float32], Float32]] = {"tanh": np.tanh, "relu": lambda x: np.maximum(x, np.float32(0))}
_OUTPUT: Mapping[str, Callable[[Float32], Float32]] = {"clip": lambda x: np.clip(x, -1.0, 1.0), "tanh": np.tanh}

_ACTOR, _CRITIC = "layer", "value_layer"  # prefixes of the names of arrays

_STORED = (np.float32, np.float16)  # types of numbers in a weights file

MAX_LAYERS, MAX_WIDTH = 16, 1 << 14
"""Largest number of layers, and of entries in each."""


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


class _Network(_Part):
    kind: Literal["mlp"] = "mlp"
    sizes: list[PositiveInt] = Field(min_length=2, max_length=MAX_LAYERS + 1)
    activation: Literal["tanh", "relu"]
    output: Literal["clip", "tanh"] = "clip"


def _checked_choice(value: Any) -> Any:
    if not isinstance(value, str | dict | None):
        raise ValueError(f"Input should be a valid string or mapping, got {value!r}")
    return value


_Choice = Annotated[Any, AfterValidator(_checked_choice)]
"""Name, or own object by reference or as the mapping of an instance."""


class _EnvOptions(_Part):
    """Keywords of `gymnasium.make` that a policy may require."""

    robot: str | None = None
    observation: _Choice = None
    action: _Choice = "joint"  # of files from before "tip_velocity" became the default
    rate: float | None = None
    task: _Choice = None
    plants: Literal["compliant"] | None = None
    physics: Literal["truth"] | None = None


class Description(_Part):
    """Content of a policy's JSON file."""

    schema_version: Literal[2] = 2
    network: _Network
    value_sizes: list[PositiveInt] | None = Field(default=None, min_length=2, max_length=MAX_LAYERS + 1)
    observation_layout: list[tuple[str, PositiveInt]] = Field(max_length=1000)
    env_options: _EnvOptions
    weights_sha256: str
    training: dict[str, Any]


@dataclass(frozen=True, eq=False, kw_only=True)
class Policy:
    """A perceptron from observations to actions in [-1, 1], and the environment it was trained for.

    Attributes:
        weights: Per layer (outputs, inputs).
        biases: Per layer (outputs,).
        activation: Of the hidden layers: "tanh" or "relu".
        center: (size,) subtracted from observations.
        scale: (size,) that centered observations are divided by.
        output: Bound of the actions: "clip" or "tanh".
        env_options: Keywords of `gymnasium.make` for that environment.
        layout: Name and number of entries of each group of the observation.
        training: Algorithm, settings and progress of its training.
        value_weights: Per layer of the critic, a network of the same inputs and activation with one output; empty
            without a critic.
        value_biases: Per layer of the critic.
    """

    weights: tuple[Float32, ...]
    biases: tuple[Float32, ...]
    activation: str
    center: Float32
    scale: Float32
    output: str = "clip"
    env_options: Mapping[str, Any]
    layout: tuple[tuple[str, int], ...]
    training: Mapping[str, Any] = field(default_factory=dict)
    value_weights: tuple[Float32, ...] = ()
    value_biases: tuple[Float32, ...] = ()

    def __call__(self, observations: npt.ArrayLike) -> Float32:
        """Return actions (k,) or (n, k) for observations (size,) or (n, size).

        The action for an observation has the same bits alone and in a batch.

        Raises:
            InvalidValueError: The observations have another size.
        """
        return _OUTPUT[self.output](self._network(observations, self.weights, self.biases))

    def value(self, observations: npt.ArrayLike) -> Float32:
        """Return the critic's values (n,) of observations (n, size): the expected discounted sum of rewards.

        Raises:
            InvalidValueError: The policy has no critic, or the observations have another size.
        """
        if not self.value_weights:
            raise InvalidValueError("this policy has no critic to value observations")
        return self._network(observations, self.value_weights, self.value_biases)[..., 0]

    def _network(
        self, observations: npt.ArrayLike, weights: tuple[Float32, ...], biases: tuple[Float32, ...]
    ) -> Float32:
        x = np.asarray(observations, dtype=np.float32)
        if x.shape[-1:] != self.center.shape:
            raise InvalidValueError(f"expected inputs of {len(self.center)} entries, got shape {x.shape}")
        x = ((x - self.center) / self.scale)[..., None]
        # products with one vector each: a product of matrices rounds differently for another number of rows
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            x = _HIDDEN[self.activation](weight @ x + bias[:, None])
        return np.asarray((weights[-1] @ x)[..., 0] + biases[-1])

    def save(self, path: str | Path) -> Path:
        """Write ``path``.safetensors (weights) and then ``path``.json (everything else); return the latter.

        Raises:
            InvalidValueError: A file cannot describe its environment, or its parts do not fit together.
        """
        description_file = description_path(path)
        arrays = {"center": self.center, "scale": self.scale}
        for prefix, weights, biases in (
            (_ACTOR, self.weights, self.biases),
            (_CRITIC, self.value_weights, self.value_biases),
        ):
            for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
                arrays[f"{prefix}_{i}.weight"], arrays[f"{prefix}_{i}.bias"] = weight, bias
        content = _safetensors().save({k: _compact(a) for k, a in arrays.items()})
        try:
            description = Description(
                network=_Network(
                    sizes=_sizes(self.weights),
                    activation=self.activation,  # type: ignore[arg-type]
                    output=self.output,  # type: ignore[arg-type]
                ),
                value_sizes=_sizes(self.value_weights) if self.value_weights else None,
                observation_layout=list(self.layout),
                env_options=_EnvOptions(**{"action": EnvSettings().action, **self.env_options}),
                weights_sha256=hashlib.sha256(content).hexdigest(),
                training=dict(self.training),
            )
        except ValidationError as error:
            raise InvalidValueError(f"this policy cannot be written: {first_fault(error)}") from error
        if flaw := _flaw(arrays, description):
            raise InvalidValueError(f"this policy cannot be written: {flaw}")
        try:
            text = description.model_dump_json(indent=1, exclude_none=True)
        except ValueError as error:
            raise InvalidValueError(
                f"this policy cannot be written: its notes on training are not JSON: {error}"
            ) from error
        write_atomically(description_file.with_suffix(".safetensors"), content)
        return write_atomically(description_file, text + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Policy:
        """Read a policy by its path, with or without a suffix.

        Raises:
            FileFormatError: A file is missing or damaged, or the two files do not belong together.
        """
        description_file = description_path(path)
        weights_file = description_file.with_suffix(".safetensors")
        with parsing(description_file, "policy's description"):
            description = Description.model_validate_json(read_bytes(description_file, "settings"))
        content = read_bytes(weights_file, "policy")
        if hashlib.sha256(content).hexdigest() != description.weights_sha256:
            raise FileFormatError(weights_file, f"checksum differs from the one in {description_file.name}")
        with parsing(weights_file, "safetensors file"):
            arrays = _safetensors().load(content)
        if flaw := _flaw(arrays, description):
            raise FileFormatError(weights_file, f"does not fit {description_file.name}: {flaw}")
        # Products of unaligned arrays, as a file may contain them, are summed in another order.
        aligned = {name: np.require(array, np.float32, ["C", "A"]) for name, array in arrays.items()}

        def layers(prefix: str, kind: str, sizes: list[int]) -> tuple[Float32, ...]:
            return tuple(aligned[f"{prefix}_{i}.{kind}"] for i in range(len(sizes) - 1))

        actor, critic = description.network.sizes, description.value_sizes or []
        return cls(
            weights=layers(_ACTOR, "weight", actor),
            biases=layers(_ACTOR, "bias", actor),
            value_weights=layers(_CRITIC, "weight", critic),
            value_biases=layers(_CRITIC, "bias", critic),
            activation=description.network.activation,
            center=aligned["center"],
            scale=aligned["scale"],
            env_options=description.env_options.model_dump(exclude_none=True),
            layout=tuple(description.observation_layout),
            training=description.training,
            output=description.network.output,
        )


def _flaw(arrays: Mapping[str, npt.NDArray[Any]], description: Description) -> str:
    """Return the reason why weights do not fit the described network; empty if they do."""
    sizes, critic = description.network.sizes, description.value_sizes
    if max(*sizes, *(critic or [])) > MAX_WIDTH:
        return f"a layer has {max(*sizes, *(critic or []))} entries, at most {MAX_WIDTH} are allowed"
    if (entries := sum(size for _, size in description.observation_layout)) and entries != sizes[0]:
        return f"the observation_layout has {entries} entries, the network takes {sizes[0]}"
    if critic and (critic[0] != sizes[0] or critic[-1] != 1):
        return f"value_sizes must begin with {sizes[0]} and end with 1, got {critic}"
    layout = tuple(description.observation_layout)
    if flaw := goal_features.flaw_of(layout) or goal_inputs.flaw_of(layout, critic is not None):
        return flaw
    shapes: dict[str, tuple[int, ...]] = {"center": (sizes[0],), "scale": (sizes[0],)}
    for prefix, widths in ((_ACTOR, sizes), (_CRITIC, critic or [])):
        for i, (inputs, outputs) in enumerate(pairwise(widths)):
            shapes |= {f"{prefix}_{i}.weight": (outputs, inputs), f"{prefix}_{i}.bias": (outputs,)}
    for name, shape in shapes.items():
        array = arrays.get(name)
        if array is None or array.shape != shape or array.dtype not in _STORED:
            found = "nothing" if array is None else f"{array.dtype} of shape {array.shape}"
            return f"{name} must be float32 or float16 of shape {shape}, found {found}"
        if not np.isfinite(array).all():
            return f"{name} has entries that are not finite"
    if unknown := sorted(arrays.keys() - shapes.keys()):
        return f"unknown array {unknown[0]!r}"
    return "" if arrays["scale"].all() else "scale has zeros"


def _compact(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return an array in half precision if that changes no entry, otherwise in single precision."""
    single = np.ascontiguousarray(array, dtype=np.float32)
    with np.errstate(over="ignore"):
        half = single.astype(np.float16)
    return half if np.array_equal(half, single) else single


def _sizes(weights: tuple[Float32, ...]) -> list[int]:
    return [weights[0].shape[1], *(weight.shape[0] for weight in weights)]


def policy_path(path: str | Path) -> Path:
    """Return a policy's path without the suffix of its files."""
    path = Path(path)
    return path.with_suffix("") if path.suffix in (".json", ".safetensors") else path


def description_path(path: str | Path) -> Path:
    """Return the JSON file of the policy at a path with or without suffix."""
    stem = policy_path(path)
    return stem.parent / f"{stem.name}.json"


def _safetensors() -> Any:
    try:
        import safetensors.numpy
    except ImportError as error:
        raise MissingDependencyError("safetensors", "train") from error
    return safetensors.numpy
