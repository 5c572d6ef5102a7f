"""Imitation of the `Guide` where the learner itself leads (DAgger: Ross, Gordon and Bagnell, 2011)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from greenhouse_gym.agents.guide import Guide, towards
from greenhouse_gym.envs import GreenhouseVectorEnv
from greenhouse_gym.envs.observations import Observed
from greenhouse_gym.errors import InvalidValueError, MissingDependencyError
from greenhouse_gym.geometry import Array

try:
    import torch
except ImportError as error:  # pragma: no cover - depends on the installation
    raise MissingDependencyError("torch", "train") from error

EVERY = 4
"""Steps after which the teacher looks for the way anew."""


@dataclass(frozen=True)
class ImitationSettings:
    """Settings of an imitation.

    Attributes:
        steps: Steps that are labeled, of all simulations together.
        num_envs: Simulations.
        round_steps: Steps of each simulation between two trainings.
        led: Share of the steps at the beginning over which the teacher's share of leading falls from one to zero.
        noise: Standard deviation of what is added to the actions that are done, not to those that are learned.
        passes: How often each label is used on average in training.
        batch_size: Labels per gradient step.
        learning_rate: Learning rate at the start; it falls to a tenth of that.
    """

    steps: int = 200_000
    num_envs: int = 64
    round_steps: int = 50
    led: float = 0.3
    noise: float = 0.1
    passes: int = 24
    batch_size: int = 1024
    learning_rate: float = 1e-3


class Teachers:
    """A teacher for the episode of every simulation of an environment, and its labels.

    Where the observation tells a waypoint to which the way is free, the teacher goes there; elsewhere the `Guide` says
    where, who plans. So the learner sees what the teacher goes by, but for the plans.

    Args:
        env: Its observation tells waypoints.
    """

    def __init__(self, env: GreenhouseVectorEnv):
        self._simulation = env.simulation
        self._steps: Array = env.simulation.action_rule.peak  # type: ignore[attr-defined]
        self._guides: list[Guide | None] = [None] * env.num_envs
        self._waypoints: list[Array | None] = [None] * env.num_envs
        self._ages = np.zeros(env.num_envs, dtype=int)

    def begin(self, i: int) -> None:
        """Make ready for a new episode of a simulation."""
        self._guides[i], self._ages[i] = None, 0

    def labels(self) -> Array:
        """What the teachers would do now, (n, joints); NaN where they know no way."""
        command, state = self._simulation.command, self._simulation.state
        assert state is not None
        labels = np.full(command.shape, np.nan)
        for i, (offset, free) in enumerate(zip(state.waypoint, state.path_free, strict=True)):
            if free:
                waypoint, self._ages[i] = command[i] + offset, 0
            else:
                waypoint = self._planned(i, command[i])
            if waypoint is not None:
                labels[i] = towards(waypoint, command[i], self._steps)
        return labels

    def _planned(self, i: int, command: Array) -> Array | None:
        """Where the guide of a simulation goes."""
        guide = self._guides[i]
        if guide is None:
            compiled, target = self._simulation.physical(i)
            guide = self._guides[i] = Guide(compiled, target, self._simulation.episode(i).start)
        if self._ages[i] % EVERY == 0:
            self._waypoints[i] = guide.waypoint(command)
        self._ages[i] += 1
        return self._waypoints[i]


def follow_waypoint(policy: Any) -> None:
    """Make the actor of an untrained Stable-Baselines3 policy do exactly as the agent ``waypoint`` does.

    So nothing has to be learned of what a rule knows. The first hidden units carry what is positive of the waypoint's
    direction and what is negative, while the way is free; the others are as they were, without any effect on the action
    until something is learned.

    Args:
        policy: An actor-critic policy with rectified linear units on `ScaledObservation` of ``"waypoint"``.

    Raises:
        InvalidValueError: Its activations are others, its layers are too narrow, or it is told no waypoint.
    """
    extractor, actions = policy.pi_features_extractor, policy.action_net
    joints = actions.out_features
    place, way = (extractor.starts.get(name, -1) for name in ("waypoint_direction", "path"))
    layers = [layer for layer in policy.mlp_extractor.policy_net if hasattr(layer, "in_features")]
    if place < 0 or policy.activation_fn is not torch.nn.ReLU or min(p.out_features for p in layers) < 2 * joints:
        raise InvalidValueError(
            f'to follow waypoints, a policy needs observation="waypoint", activation="relu" and hidden layers of at '
            f"least {2 * joints} units"
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


def imitate(
    policy: Any,
    env: GreenhouseVectorEnv,
    settings: ImitationSettings,
    seed: int = 0,
    tell: Callable[[int, dict[str, float]], None] = lambda steps, figures: None,
) -> None:
    """Train the actor of a Stable-Baselines3 policy to do as the teacher does.

    Args:
        policy: An actor-critic policy; its actor and features are trained.
        env: Vector environment with ``autoreset_mode="SameStep"``, on the arm and observation of the policy; it
            tells waypoints.
        settings: The settings.
        seed: Seed of episodes and noise.
        tell: Gets the steps so far and figures after each round.
    """
    random = np.random.default_rng(seed)
    torch.manual_seed(seed)
    parameters = [*policy.mlp_extractor.policy_net.parameters(), *policy.action_net.parameters()]
    optimizer: Any = torch.optim.Adam(parameters, lr=settings.learning_rate)
    rounds = max(1, settings.steps // (settings.num_envs * settings.round_steps))
    teachers = Teachers(env)
    seen, _ = env.reset(seed=seed)
    for i in range(env.num_envs):
        teachers.begin(i)
    leads = np.ones(env.num_envs, dtype=np.bool_)
    inputs: list[Observed] = []
    labels: list[Array] = []
    updates = settings.steps * settings.passes // (settings.batch_size * rounds)
    for k in range(rounds):
        share = max(0.0, 1.0 - k / max(1.0, settings.led * rounds))
        ended = won = 0
        began = time.perf_counter()
        for _ in range(settings.round_steps):
            label = teachers.labels()
            known = np.isfinite(label[:, 0])
            inputs.append(seen[known])  # type: ignore[index]
            labels.append(label[known])
            own = _mean(policy, seen)
            action = np.where((leads & known)[:, None], label, own)
            action = action + settings.noise * random.normal(size=action.shape)
            seen, _, terminated, truncated, infos = env.step(action)
            for i in np.flatnonzero(terminated | truncated).tolist():
                if not leads[i]:
                    ended, won = ended + 1, won + bool(infos["final_info"]["is_success"][i])
                teachers.begin(i)
                leads[i] = random.random() < share
        collected = time.perf_counter() - began
        rate = settings.learning_rate * (0.1 + 0.9 * (1 - k / rounds))
        for group in optimizer.param_groups:
            group["lr"] = rate
        x = torch.as_tensor(np.concatenate(inputs))  # type: ignore[arg-type]
        y = torch.as_tensor(np.concatenate(labels), dtype=torch.float32)
        loss = 0.0
        for _ in range(updates):
            batch = torch.as_tensor(random.integers(len(x), size=settings.batch_size))
            error: Any = (_forward(policy, x[batch]) - y[batch]).abs().mean()
            optimizer.zero_grad()
            error.backward()
            optimizer.step()
            loss += float(error.detach()) / updates
        seconds = time.perf_counter() - began - collected
        figures = {
            "loss": loss, "success": won / max(1, ended), "episodes": float(ended), "labels": float(len(x)),
            "collecting": collected, "training": seconds,
        }  # fmt: skip
        tell((k + 1) * settings.num_envs * settings.round_steps, figures)


def _forward(policy: Any, inputs: torch.Tensor) -> torch.Tensor:
    return policy.action_net(policy.mlp_extractor.forward_actor(policy.pi_features_extractor(inputs)))


def _mean(policy: Any, seen: Any) -> Array:
    with torch.no_grad():
        return np.asarray(_forward(policy, torch.as_tensor(seen)).numpy(), dtype=np.float64)
