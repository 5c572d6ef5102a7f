"""PPO with rollouts on the device of the Warp environment; on a GPU, rollouts and updates are CUDA graphs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.common.extras import needs
from greenhouse_gym.envs.choices import step_limit_of
from greenhouse_gym.envs.rewards import DenseReward
from greenhouse_gym.envs.settings import EnvSettings
from greenhouse_gym.errors import DivergedError, InvalidValueError
from greenhouse_gym.learning.settings import DevicePpoSettings
from greenhouse_gym.scene import SceneBank

with needs("train"):
    import torch
    from torch import Tensor, nn

    from greenhouse_gym.learning.device_goals import GoalChoices, begin_as_straight_line
    from greenhouse_gym.learning.device_networks import Networks
    from greenhouse_gym.learning.training_files import MAX_WEIGHT

_LOG_2PI = math.log(2 * math.pi)


class DevicePpo:
    """State of a training: environment, networks, and the buffers of a rollout.

    Args:
        settings: The settings.

    Raises:
        InvalidValueError: Goals are asked for with other actions than "joint", on a GPU, or with small hidden layers.

    Attributes:
        env: The environment, which returns tensors.
        steps: Environment steps so far.
        learning_rate: Current learning rate.
    """

    def __init__(self, settings: DevicePpoSettings):
        from greenhouse_gym.envs.warp import WarpVectorEnv

        if settings.goals and (settings.action, settings.device) != ("joint", "cpu"):
            raise InvalidValueError(
                f'goals need action="joint" and device="cpu", got {settings.action!r} and {settings.device!r}'
            )
        self.settings, self.steps, self.learning_rate = settings, 0, settings.learning_rate
        self._caution = 1.0  # factor of the learning rate that follows the divergence
        torch.manual_seed(settings.seed)
        self._bank = rows = SceneBank.open(settings.bank)
        if settings.sources:
            rows = self._bank.select(settings.split, source=settings.sources)
        self.env = WarpVectorEnv(
            settings.num_envs,
            EnvSettings(
                rows, settings.split, settings.robot, action=settings.action, difficulty=settings.difficulty,
                reward=DenseReward(collision=settings.collision), scene=settings.scene, target=settings.target,
            ),
            device=settings.device, arrays="torch",
        )  # fmt: skip
        self._observation, _ = self.env.reset(seed=settings.seed)
        device = self._device = self._observation.device
        count, size = self._observation.shape
        # episodes that all began together would also all end together
        ages = np.random.default_rng(settings.seed).integers(step_limit_of(self.env.settings), size=count)
        self.env.simulation.state.steps.assign(ages.astype(np.int32))
        actions = int(self.env.simulation.action.shape[1])
        self._layout = self.env.simulation.observe.layout
        self._choices: GoalChoices | None = None
        if settings.goals:
            self._choices = GoalChoices(self.env, settings.goals)
            self._layout = self._choices.layout
            size = sum(width for _, width in self._layout)
        self.networks = Networks(size, actions, settings, self._layout).to(device)
        if self._choices is not None:
            begin_as_straight_line(self.networks, self._layout)
            with torch.no_grad():
                everyone = torch.ones(count, dtype=torch.bool)
                self._observation = self._choices(self._observation, self.networks, everyone)
        steps = settings.rollout_steps
        shapes: dict[str, tuple[int, ...]] = {
            "observations": (steps + 1, count, size),
            "actions": (steps, count, actions),
        }
        shapes |= {"values": (steps + 1, count)}
        shapes |= dict.fromkeys(
            ("chances", "rewards", "terminal", "ended", "used", "advantages", "returns"), (steps, count)
        )
        self._buffers = {name: torch.zeros(shape, device=device) for name, shape in shapes.items()}
        self._waiting, self._score = torch.zeros(count, device=device), torch.zeros(count, device=device)
        self._sums = torch.zeros(5, device=device)  # episodes, successes, collisions, returns, lengths
        self._kl = torch.zeros(1, device=device)
        self._minibatch = torch.zeros(steps * count // settings.minibatches, dtype=torch.int64, device=device)
        graphs = device.type == "cuda"
        rate: Any = torch.tensor(self.learning_rate, device=device) if graphs else self.learning_rate
        self._optimizer = torch.optim.Adam(self.networks.parameters(), lr=rate, eps=1e-5, capturable=graphs)
        self._roll, self._update = self._rollout, self._gradient_step
        if graphs:
            self._roll = _graph(self._rollout)
            self._update = self._captured_update()

    def iterate(self, left: float) -> float:
        """Make a rollout and update the networks with it; return the divergence of the policy.

        Args:
            left: Fraction of the training that is left; the learning rate is proportional to it.
        """
        settings = self.settings
        self.learning_rate = settings.learning_rate * left * self._caution
        for group in self._optimizer.param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(self.learning_rate)
            else:
                group["lr"] = self.learning_rate
        self._roll()
        total = settings.num_envs * settings.rollout_steps
        size = len(self._minibatch)
        for _ in range(settings.epochs):
            order = torch.randperm(total, device=self._device)
            self._kl.zero_()
            for k in range(settings.minibatches):
                self._minibatch.copy_(order[k * size : (k + 1) * size])
                self._update()
        kl = float(self._kl) / settings.minibatches
        if kl > 2 * settings.divergence:
            self._caution /= 1.5
        elif kl < settings.divergence / 2:
            self._caution = min(1.0, 1.5 * self._caution)
        self.steps += total
        return kl

    def figures(self) -> dict[str, float]:
        """Return the averages over the episodes that ended since the last call."""
        episodes, *sums = self._sums.tolist()
        self._sums.zero_()
        names = ("success_rate", "collision_rate", "return", "length")
        return {
            name: round(value / episodes, 5) if episodes else math.nan for name, value in zip(names, sums, strict=True)
        }

    def save(self, out: Path) -> Path:
        """Write the policy and return the path of its JSON file.

        Raises:
            DivergedError: Weights are not finite or explode; the policy written before is kept.
        """
        if not all(bool((weights.detach().abs() <= MAX_WEIGHT).all()) for weights in self.networks.parameters()):
            raise DivergedError(
                f"the training diverged within {self.steps:,} steps: weights are not finite or explode; what was "
                f"written to {out} before is kept. A lower learning_rate may help"
            )
        return self.policy().save(out / "policy")

    def policy(self) -> Policy:
        """Return the mean of the actor as a policy."""
        layers = [layer for layer in self.networks.actor if isinstance(layer, nn.Linear)]
        critic = [layer for layer in self.networks.critic if isinstance(layer, nn.Linear)] if self._choices else []

        def numbers(tensor: Tensor) -> np.ndarray[Any, Any]:
            return tensor.detach().cpu().numpy().astype(np.float32)

        return Policy(
            weights=tuple(numbers(layer.weight) for layer in layers),
            biases=tuple(numbers(layer.bias) for layer in layers),
            activation="relu",
            center=numbers(self.networks.center),
            scale=numbers(self.networks.scale),
            env_options=self.env.settings.agent_options(),
            layout=self._layout,
            value_weights=tuple(numbers(layer.weight) for layer in critic),
            value_biases=tuple(numbers(layer.bias) for layer in critic),
            training={
                "algorithm": "PPO on a device",
                "steps": self.steps,
                "settings": json.loads(json.dumps(asdict(self.settings))),
                "bank_sha256": self._bank.sha256,
            },
        )  # fmt: skip

    @torch.no_grad()
    def _rollout(self) -> None:
        """Fill the buffers with steps of all simulations, and compute advantages and returns."""
        b, networks, settings = self._buffers, self.networks, self.settings
        log_std = networks.log_std
        constant = -log_std.sum() - 0.5 * _LOG_2PI * len(log_std)
        for t in range(settings.rollout_steps):
            b["observations"][t].copy_(self._observation)
            mean, value = networks(b["observations"][t])
            noise = torch.randn_like(mean)
            b["values"][t].copy_(value)
            b["actions"][t].copy_(mean + log_std.exp() * noise)
            b["chances"][t].copy_(constant - 0.5 * (noise * noise).sum(1))
            # the environment clips actions, and ignores those of the step that begins an episode
            observation, reward, terminated, truncated, info = self.env.step(b["actions"][t])
            self._observation = self._choices(observation, networks) if self._choices else observation
            b["used"][t].copy_(1 - self._waiting)
            b["rewards"][t].copy_(reward)
            b["terminal"][t].copy_(terminated)
            torch.logical_or(terminated, truncated, out=b["ended"][t])
            ended = b["ended"][t]
            self._waiting.copy_(ended)
            self._score.add_(reward)
            measured = torch.stack(
                [torch.ones_like(reward), info["is_success"], info["collision"], self._score, info["steps"]]
            )
            self._sums.add_((measured * ended).sum(1))
            self._score.mul_(1 - ended)
        b["observations"][-1].copy_(self._observation)
        b["values"][-1].copy_(networks(b["observations"][-1])[1])
        advantage = torch.zeros_like(b["values"][0])
        for t in reversed(range(settings.rollout_steps)):
            expected = b["rewards"][t] + settings.discount * b["values"][t + 1] * (1 - b["terminal"][t])
            going_on = settings.discount * settings.gae_lambda * (1 - b["ended"][t])
            advantage = expected - b["values"][t] + going_on * advantage
            b["advantages"][t].copy_(advantage)
        b["returns"].copy_(b["advantages"] + b["values"][:-1])
        used = b["used"]
        mean = (b["advantages"] * used).sum() / used.sum()
        deviation = (((b["advantages"] - mean) ** 2 * used).sum() / used.sum()).sqrt()
        b["advantages"].sub_(mean).div_(deviation + 1e-8)

    def _gradient_step(self) -> None:
        """Update the networks with the samples of the current minibatch."""
        settings, networks, rows = self.settings, self.networks, self._minibatch
        b = {name: values[: settings.rollout_steps].flatten(0, 1)[rows] for name, values in self._buffers.items()}
        mean, value = networks(b["observations"])
        deviation = (b["actions"] - mean) * (-networks.log_std).exp()
        chance = -0.5 * (deviation * deviation).sum(1) - networks.log_std.sum() - 0.5 * _LOG_2PI * deviation.shape[1]
        change = chance - b["chances"]
        ratio = change.exp()
        weight = b["used"] / b["used"].sum()
        clipped = ratio.clamp(1 - settings.clip_range, 1 + settings.clip_range)
        gain = torch.minimum(b["advantages"] * ratio, b["advantages"] * clipped)
        loss = (weight * (0.25 * (value - b["returns"]) ** 2 - gain)).sum()
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.networks.parameters(), 0.5)
        self._optimizer.step()
        self._kl.add_((weight * (ratio - 1 - change)).sum().detach())

    def _captured_update(self) -> Callable[[], None]:
        """Return the update as a graph; capturing it changes neither the networks nor the optimizer."""
        self._roll()
        before = [parameter.detach().clone() for parameter in self.networks.parameters()]
        self._minibatch.copy_(torch.arange(len(self._minibatch), device=self._device))
        replay = _graph(self._gradient_step)
        with torch.no_grad():
            for parameter, value in zip(self.networks.parameters(), before, strict=True):
                parameter.copy_(value)
            for state in self._optimizer.state.values():
                for value in state.values():
                    value.zero_()
        return replay


def _graph(function: Callable[[], None]) -> Callable[[], None]:
    """Return a function as a replayable CUDA graph, after warming it up."""
    stream: Any = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(2):
            function()
    torch.cuda.current_stream().wait_stream(stream)
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        function()
    replay: Callable[[], None] = graph.replay
    return replay
