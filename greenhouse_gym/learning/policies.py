"""From a Stable-Baselines3 model to a policy file that needs numpy only."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.integrations.sb3 import simulation_of

# Names, for torch is not imported here: playing a policy needs none.
_ACTIVATION_NAMES = {"Tanh": "tanh", "ReLU": "relu"}
_EXTRACTORS = ("FlattenExtractor", "ScaledObservation")


def policy_of(
    model: Any, env_options: Mapping[str, Any], layout: tuple[tuple[str, int], ...], training: Mapping[str, Any]
) -> Policy:
    """The mean of a Stable-Baselines3 actor (with an MLP and a scaling extractor, as `train_ppo` makes it) in numpy.

    Raises:
        InvalidValueError: The model is another kind of network.
    """
    network = model.policy
    extractor: Any = getattr(network, "pi_features_extractor", None)
    if type(extractor).__name__ not in _EXTRACTORS or not hasattr(network, "mlp_extractor"):
        space = type(getattr(network, "observation_space", None)).__name__
        raise InvalidValueError(
            f"a policy file holds a plain network from a vector of numbers to the mean action, as PPO and A2C have it; "
            f"got {type(model).__name__} on a {space} space: save the model itself and play it with "
            "greenhouse_gym.integrations.sb3.Sb3Agent"
        )
    activation = _ACTIVATION_NAMES.get(network.activation_fn.__name__)
    if activation is None or hasattr(network, "lstm_actor"):
        raise InvalidValueError(
            f"a policy file knows the activations {', '.join(_ACTIVATION_NAMES)} and no memory, "
            f"got {type(model).__name__} with {network.activation_fn.__name__}"
        )
    linear = [layer for layer in network.mlp_extractor.policy_net if hasattr(layer, "in_features")]
    linear.append(network.action_net)
    size = linear[0].in_features

    def numbers(tensor: Any) -> npt.NDArray[np.float32]:
        return np.array(tensor.detach().cpu().numpy(), dtype=np.float32)

    return Policy(
        weights=tuple(numbers(layer.weight) for layer in linear),
        biases=tuple(numbers(layer.bias) for layer in linear),
        activation=activation,
        center=numbers(extractor.center) if hasattr(extractor, "center") else np.zeros(size, dtype=np.float32),
        scale=numbers(extractor.scale) if hasattr(extractor, "scale") else np.ones(size, dtype=np.float32),
        env_options=env_options,
        layout=layout,
        training=training,
    )


def load_into(model: Any, policy: Policy) -> None:
    """Put a policy's weights into the actor of an untrained model of `make_ppo`, to train on from there.

    Args:
        model: The model of Stable-Baselines3.
        policy: A policy for the same arm, with the same observation and hidden layers.

    Raises:
        InvalidValueError: Its network or observation is another.
    """
    import torch

    actor = model.policy
    layers = [*(layer for layer in actor.mlp_extractor.policy_net if hasattr(layer, "in_features")), actor.action_net]
    theirs = [tuple(weight.shape) for weight in policy.weights]
    ours = [tuple(layer.weight.shape) for layer in layers]
    activation = _ACTIVATION_NAMES.get(actor.activation_fn.__name__)
    if theirs != ours or policy.activation != activation:
        raise InvalidValueError(
            f"the policy has layers of {theirs} with {policy.activation}, the model {ours} with {activation}"
        )
    extractor = actor.pi_features_extractor
    for name in ("center", "scale"):
        if not np.array_equal(getattr(policy, name), getattr(extractor, name).numpy()):
            raise InvalidValueError(f"the policy scales its observation otherwise than the model: {name} differs")
    with torch.no_grad():
        for layer, weight, bias in zip(layers, policy.weights, policy.biases, strict=True):
            layer.weight.copy_(torch.as_tensor(weight))
            layer.bias.copy_(torch.as_tensor(bias))


def save_policy(model: Any, path: str | Path, training: Mapping[str, Any] | None = None) -> Path:
    """Write a Stable-Baselines3 model trained on `make_sb3_vec_env` as a policy file.

    Args:
        model: The model; its environment tells robot, observation and action.
        path: Where to, without suffix.
        training: What to note about how it came about.

    Returns:
        The path of the JSON file; the weights lie beside it.

    Raises:
        InvalidValueError: The model is no plain network on a vector of numbers, or was not trained on this environment.
    """
    simulation = simulation_of(model)
    if simulation is None:
        raise InvalidValueError(
            "the model has no environment of this package: which arm and action it is for is unknown"
        )
    notes = {"algorithm": type(model).__name__, "steps": int(model.num_timesteps), **(training or {})}
    return policy_of(model, simulation.env_options, simulation.observe.layout, notes).save(path)
