"""Conversion of Stable-Baselines3 models to policy files that need only numpy, and back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.goal_features import GOAL_FEATURES, GOAL_FEATURES_SIZE
from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.common.own_code import portable
from greenhouse_gym.envs.features import Layout
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.learning.sb3 import simulation_of

# Names of classes, because this module does not import torch.
_ACTIVATION_NAMES = {"Tanh": "tanh", "ReLU": "relu"}
_PLAIN, _GOALS = ("FlattenExtractor", "ScaledObservation"), "GoalFeatures"


class _Actor(NamedTuple):
    """The network that computes the mean action of a Stable-Baselines3 model.

    Attributes:
        layers: Its linear layers.
        activation: Name of the function between them.
        output: Name of the function after them.
        center: (size,) offset subtracted from the input.
        scale: (size,) divisor of the input after that.
        features: Groups of the input that follow the observation.
    """

    layers: list[Any]
    activation: str
    output: str
    center: npt.NDArray[np.float32]
    scale: npt.NDArray[np.float32]
    features: Layout = ()


def _actor_of(model: Any) -> _Actor:
    network = model.policy
    activation = _ACTIVATION_NAMES.get(getattr(getattr(network, "activation_fn", None), "__name__", ""), "")
    own = getattr(network, "actor", None)
    extractor: Any = getattr(own if own is not None else network, "features_extractor", None)
    kind = type(extractor).__name__
    if own is not None and kind == _GOALS:
        layers, scaled, output = [*_linear(own.latent_pi), own.mu], extractor.scaled, "tanh"
    elif own is None and kind in (*_PLAIN, _GOALS) and hasattr(network, "mlp_extractor"):
        layers, output = [*_linear(network.mlp_extractor.policy_net), network.action_net], "clip"
        scaled = extractor.scaled if kind == _GOALS else extractor
    else:
        space = type(getattr(network, "observation_space", None)).__name__
        raise InvalidValueError(
            f"a policy file holds a plain network from a vector to the mean action, such as those of PPO and A2C, "
            f"or the actor of `greenhouse_gym.learning.sac`; got {type(model).__name__} on a {space} space: save the "
            "model itself and use it with greenhouse_gym.learning.sb3.Sb3Agent"
        )
    if not activation or hasattr(network, "lstm_actor"):
        raise InvalidValueError(
            f"a policy file supports the activations {', '.join(_ACTIVATION_NAMES)} and no recurrent networks, "
            f"got {type(model).__name__} with {network.activation_fn.__name__}"
        )
    extra = GOAL_FEATURES_SIZE if kind == _GOALS else 0
    size = layers[0].in_features - extra
    center = _numbers(scaled.center) if hasattr(scaled, "center") else np.zeros(size, dtype=np.float32)
    scale = _numbers(scaled.scale) if hasattr(scaled, "scale") else np.ones(size, dtype=np.float32)
    return _Actor(
        layers,
        activation,
        output,
        np.pad(center, (0, extra)),
        np.pad(scale, (0, extra), constant_values=1.0),
        ((GOAL_FEATURES, extra),) if extra else (),
    )


def fits_policy_file(model: Any) -> bool:
    """Return whether a policy file can hold the actor of a Stable-Baselines3 model; see `policy_of`."""
    try:
        _actor_of(model)
    except InvalidValueError:
        return False
    return True


def _linear(layers: Any) -> list[Any]:
    return [layer for layer in layers if hasattr(layer, "in_features")]


def _numbers(tensor: Any) -> npt.NDArray[np.float32]:
    return np.array(tensor.detach().cpu().numpy(), dtype=np.float32)


def policy_of(model: Any, env_options: Mapping[str, Any], layout: Layout, training: Mapping[str, Any]) -> Policy:
    """Convert the mean of a Stable-Baselines3 actor of `train_ppo` or `train_sac` to numpy.

    Raises:
        InvalidValueError: The model is another type of network, or a file cannot name an object of its environment.
    """
    actor = _actor_of(model)
    return Policy(
        weights=tuple(_numbers(layer.weight) for layer in actor.layers),
        biases=tuple(_numbers(layer.bias) for layer in actor.layers),
        activation=actor.activation,
        center=actor.center,
        scale=actor.scale,
        env_options={name: portable(value, name) for name, value in env_options.items()},
        layout=(*layout, *actor.features),
        training=training,
        output=actor.output,
    )


def load_into(model: Any, policy: Policy) -> None:
    """Load a policy's weights into the actor of an untrained model of `make_ppo` or `make_sac`, to train it further.

    Args:
        model: The model of Stable-Baselines3.
        policy: A policy for the same arm, with the same observation and hidden layers.

    Raises:
        InvalidValueError: Its network or observation differs.
    """
    import torch

    actor = _actor_of(model)
    theirs = [tuple(weight.shape) for weight in policy.weights]
    ours = [tuple(layer.weight.shape) for layer in actor.layers]
    kinds = (policy.activation, policy.output), (actor.activation, actor.output)
    if theirs != ours or kinds[0] != kinds[1]:
        raise InvalidValueError(
            f"the policy has layers of {theirs} with {' and '.join(kinds[0])}, the model {ours} with "
            f"{' and '.join(kinds[1])}"
        )
    for name in ("center", "scale"):
        if not np.array_equal(getattr(policy, name), getattr(actor, name)):
            raise InvalidValueError(f"the policy and the model scale their observations differently: {name}")
    with torch.no_grad():
        for layer, weight, bias in zip(actor.layers, policy.weights, policy.biases, strict=True):
            layer.weight.copy_(torch.as_tensor(weight))
            layer.bias.copy_(torch.as_tensor(bias))


def save_policy(model: Any, path: str | Path, training: Mapping[str, Any] | None = None) -> Path:
    """Write a Stable-Baselines3 model trained on `make_sb3_vec_env` as a policy file.

    Args:
        model: The model; robot, observation and action are those of its environment.
        path: Path of the file without suffix.
        training: Notes on the training.

    Returns:
        The path of the JSON file; the weights are in a file next to it.

    Raises:
        InvalidValueError: The model is another type of network, or was not trained on this environment.
    """
    simulation = simulation_of(model)
    if simulation is None:
        raise InvalidValueError("the model has no environment of this package, so its arm and action are unknown")
    notes = {"algorithm": type(model).__name__, "steps": int(model.num_timesteps), **(training or {})}
    return policy_of(model, simulation.settings.agent_options(), simulation.observe.layout, notes).save(path)
