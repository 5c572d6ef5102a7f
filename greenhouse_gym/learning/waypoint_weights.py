"""Weights with which an untrained network goes where a waypoint lies: what a rule knows need not be learned."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.extras import needs

with needs("train"):
    import torch

    from greenhouse_gym.integrations.sb3_features import ScaledObservation


def follow_waypoint(policy: Any) -> None:
    """Make the actor of an untrained Stable-Baselines3 policy do exactly as the agent ``waypoint`` does.

    Args:
        policy: An actor-critic policy with rectified linear units on `ScaledObservation` of ``"waypoint"``.

    Raises:
        InvalidValueError: Its activations are others, its layers are too narrow, or it is told no waypoint.
    """
    layers = [layer for layer in policy.mlp_extractor.policy_net if hasattr(layer, "in_features")]
    carry_waypoint(policy.pi_features_extractor, layers, policy.action_net, policy.activation_fn)


def carry_waypoint(extractor: ScaledObservation, layers: Sequence[Any], actions: Any, activation: Any) -> None:
    """Make a network's outputs the direction of the waypoint where the way there is free, and zero elsewhere.

    The first hidden units carry what is positive of the direction and what is negative; the others are as they were,
    without any effect on the outputs until something is learned.

    Args:
        extractor: What its first inputs come from.
        layers: Its hidden linear layers.
        actions: Its last linear layer.
        activation: Class of its activations.

    Raises:
        InvalidValueError: Its activations are others, its layers are too narrow, or it is told no waypoint.
    """
    joints = actions.out_features
    place, way = (extractor.starts.get(name, -1) for name in ("waypoint_direction", "way"))
    if place < 0 or activation is not torch.nn.ReLU or min(p.out_features for p in layers) < 2 * joints:
        raise InvalidValueError(
            'to follow waypoints, a policy needs an observation that tells them, activation="relu" and hidden layers '
            f"of at least {2 * joints} units"
        )
    units = torch.arange(2 * joints)
    carried, free = place + units % joints, way + 1
    with torch.no_grad():
        for layer in layers:
            layer.weight[units], layer.bias[units] = 0.0, 0.0
        # directions are at most 1: with 1 taken away where the way is not free, nothing positive is left
        layers[0].weight[units, carried] = torch.where(units < joints, 1.0, -1.0) * extractor.scale[carried]
        layers[0].weight[units, free] = extractor.scale[free]
        layers[0].bias[units] = extractor.center[free] - 1.0
        for layer in layers[1:]:
            layer.weight[units, units] = 1.0
        actions.weight.zero_()
        actions.bias.zero_()
        actions.weight[units % joints, units] = torch.where(units < joints, 1.0, -1.0)
