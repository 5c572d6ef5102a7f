"""SAC that starts from demonstrations in its replay buffer and is constrained towards the demonstrator."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.extras import needs
from greenhouse_gym.envs.features import Layout, feature_slices

with needs("train"):
    import torch
    from stable_baselines3 import SAC

    from greenhouse_gym.learning.training_files import parameters_of

MAX_NOISE = 0.5
"""Standard deviation of the noise on demonstrated actions (from -1 to 1) in the last of the simulations."""


class Demonstrator:
    """Follow the waypoint of a goal environment, as the agent ``roadmap`` does.

    Args:
        layout: Layout of the environment's ``"observation"``.
        seed: Seed of the noise.
    """

    def __init__(self, layout: Layout, seed: int):
        groups = feature_slices(layout)
        self._direction, self._free = groups["waypoint_direction"], groups["path"].start + 1
        self._rng = np.random.default_rng(seed)

    def actions(self, observed: dict[str, Any]) -> Any:
        """Return the demonstrator's actions (n, size), as arrays or tensors like the observation."""
        values = observed["observation"]
        return values[:, self._direction] * values[:, self._free : self._free + 1]

    def known(self, observed: dict[str, Any]) -> Any:
        """Return 1 where a collision-free waypoint is known and 0 elsewhere, (n, 1)."""
        return observed["observation"][:, self._free : self._free + 1]

    def sample(self, memory: Any, count: int) -> dict[str, Any]:
        """Sample ``count`` observations from a replay buffer, as tensors."""
        rows = self._rng.integers(memory.size(), size=count)
        index = rows, self._rng.integers(memory.n_envs, size=count)
        return {name: torch.as_tensor(part[index]) for name, part in memory.observations.items()}

    def noisy_actions(self, observed: dict[str, Any]) -> npt.NDArray[np.float32]:
        """Return actions (n, size) with noise: none in the first simulation, most in the last."""
        actions = self.actions(observed)
        noise = np.linspace(0.0, MAX_NOISE, len(actions))[:, None] * self._rng.normal(size=actions.shape)
        return np.clip(actions + noise, -1.0, 1.0).astype(np.float32)


class GuidedSAC(SAC):  # type: ignore[misc]
    """SAC that can fill its replay buffer with a demonstrator's or its own actions instead of random ones.

    With a demonstrator, the actor is constrained towards its actions in sampled observations of the buffer: the loss is
    SAC's, divided by the mean absolute value of the critics, plus `guide_weight` times the mean squared distance to the
    demonstrator's actions (Fujimoto and Gu, A Minimalist Approach to Offline Reinforcement Learning, 2021). Without the
    constraint, critics that know little except demonstrations mislead the actor.

    Attributes:
        explores: True to act at random, or like the demonstrator, while the buffer is filled.
        demonstrator: Acts then instead of chance, if given.
        guide_weight: Weight of the constraint.
    """

    explores = True
    demonstrator: Demonstrator | None = None
    guide_weight = 0.0

    def _sample_action(self, learning_starts: int, action_noise: Any = None, n_envs: int = 1) -> Any:
        if not self.explores:
            return super()._sample_action(0, action_noise, n_envs)
        if self.demonstrator is None or self.num_timesteps >= learning_starts:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        actions = self.demonstrator.noisy_actions(self._last_obs)  # already scaled: the environment's go from -1 to 1
        return actions, actions

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Make gradient steps, each with the constraint towards the demonstrator, if there is one."""
        hook = self.actor.optimizer.register_step_pre_hook(lambda *_: self._add_constraint(batch_size))
        try:
            super().train(gradient_steps, batch_size)
        finally:
            hook.remove()

    def _add_constraint(self, count: int) -> None:
        """Add the gradients of the constraint to those of SAC's actor loss, just before the optimizer's step."""
        if self.demonstrator is None:
            return
        observed = self.demonstrator.sample(self.replay_buffer, count)
        wanted, actual = self.demonstrator.actions(observed), self.actor(observed, deterministic=True)
        with torch.no_grad():
            scale = torch.cat(self.critic(observed, actual), dim=1).abs().mean() + 1.0
        distance = ((actual - wanted) ** 2 * self.demonstrator.known(observed)).mean()
        parameters = parameters_of(self.actor.optimizer)
        gradients = torch.autograd.grad(self.guide_weight * distance, parameters, allow_unused=True)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            if gradient is not None and parameter.grad is not None:
                parameter.grad.div_(scale).add_(gradient)
        self.logger.record("train/imitation_loss", distance.detach().item())
