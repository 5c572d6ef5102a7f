"""From a Stable-Baselines3 model to a policy file that needs numpy only, and how good it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.envs import TomatoReachVectorEnv

_ACTIVATION_NAMES = {"Tanh": "tanh", "ReLU": "relu"}  # torch is not imported here: playing a policy needs none


class Score(NamedTuple):
    """Shares of episodes."""

    episodes: int
    success: float
    collision: float
    steps: float


def policy_of(
    model: Any, env_options: Mapping[str, Any], layout: tuple[tuple[str, int], ...], training: Mapping[str, Any]
) -> Policy:
    """The mean of a Stable-Baselines3 actor (with an MLP and a scaling extractor, as `train_ppo` makes it) in numpy."""
    network = model.policy
    linear = [layer for layer in network.mlp_extractor.policy_net if hasattr(layer, "in_features")]
    linear.append(network.action_net)
    size = linear[0].in_features
    extractor = network.pi_features_extractor

    def numbers(tensor: Any) -> npt.NDArray[np.float32]:
        return np.array(tensor.detach().cpu().numpy(), dtype=np.float32)

    return Policy(
        weights=tuple(numbers(layer.weight) for layer in linear),
        biases=tuple(numbers(layer.bias) for layer in linear),
        activation=_ACTIVATION_NAMES[network.activation_fn.__name__],
        center=numbers(extractor.center) if hasattr(extractor, "center") else np.zeros(size, dtype=np.float32),
        scale=numbers(extractor.scale) if hasattr(extractor, "scale") else np.ones(size, dtype=np.float32),
        env_options=env_options,
        layout=layout,
        training=training,
    )


def save_policy(model: Any, path: str | Path, training: Mapping[str, Any] | None = None) -> Path:
    """Write a Stable-Baselines3 model trained on `make_sb3_vec_env` as a policy file.

    Args:
        model: The model; its environment tells robot, observation and action.
        path: Where to, without suffix.
        training: What to note about how it came about.

    Returns:
        The path of the JSON file; the weights lie beside it.
    """
    simulation = model.get_env().get_attr("simulation")[0]
    notes = {"algorithm": type(model).__name__, "steps": int(model.num_timesteps), **(training or {})}
    return policy_of(model, simulation.env_options, simulation.observe.layout, notes).save(path)


def score(
    act: Callable[[Any], npt.NDArray[np.floating[Any]]],
    episodes: int = 256,
    seed: int = 0,
    **env_options: Any,
) -> Score:
    """Play episodes, one per simulation of a vector environment, and count how they end.

    Args:
        act: From observations (n, size) to actions (n, joints).
        episodes: How many.
        seed: Episode i is the one a single environment plays first with seed + i.
        **env_options: Keywords of `TomatoReachVectorEnv`.
    """
    env = TomatoReachVectorEnv(episodes, autoreset_mode="NextStep", **env_options)
    observations, _ = env.reset(seed=seed)
    running = np.ones(episodes, dtype=np.bool_)
    success, collision = np.zeros(episodes, dtype=np.bool_), np.zeros(episodes, dtype=np.bool_)
    steps = np.zeros(episodes, dtype=np.int64)
    while running.any():
        observations, _, terminated, truncated, infos = env.step(act(observations))
        steps += running
        success |= running & infos["is_success"]
        collision |= running & infos["collision"]
        running &= ~(terminated | truncated)
    env.close()
    return Score(episodes, float(success.mean()), float(collision.mean()), float(steps.mean()))
