"""SAC that begins with demonstrations in its memory, and is held near who made them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.extras import needs
from greenhouse_gym.envs.features import Layout, feature_slices

with needs("train"):
    import torch
    from stable_baselines3 import SAC

NOISIEST = 0.5
"""Standard deviation of the noise on demonstrated actions, which go from -1 to 1, in the last of the simulations."""


class Demonstrator:
    """Goes where the waypoint of a goal environment says, as the agent ``waypoint`` does.

    Args:
        layout: Layout of the environment's ``"observation"``.
        seed: Seed of the noise.
    """

    def __init__(self, layout: Layout, seed: int):
        at = feature_slices(layout)
        self._direction, self._free = at["waypoint_direction"], at["path"].start + 1
        self._random = np.random.default_rng(seed)

    def wish(self, observed: dict[str, Any]) -> Any:
        """(n, size) the actions of the agent, as arrays or tensors are observed."""
        seen = observed["observation"]
        return seen[:, self._direction] * seen[:, self._free : self._free + 1]

    def knows(self, observed: dict[str, Any]) -> Any:
        """(n, 1) one where it knows a way, else zero."""
        return observed["observation"][:, self._free : self._free + 1]

    def places(self, memory: Any, count: int) -> dict[str, Any]:
        """Observations of (count,) places of the memory, as tensors."""
        rows = self._random.integers(memory.size(), size=count)
        places = rows, self._random.integers(memory.n_envs, size=count)
        return {name: torch.as_tensor(part[places]) for name, part in memory.observations.items()}

    def strewn(self, observed: dict[str, Any]) -> npt.NDArray[np.float32]:
        """(n, size) these actions with noise: none in the first simulation, most in the last."""
        wish = self.wish(observed)
        spread = np.linspace(0.0, NOISIEST, len(wish))[:, None]
        return np.clip(wish + spread * self._random.normal(size=wish.shape), -1.0, 1.0).astype(np.float32)


class Demonstrated(SAC):  # type: ignore[misc]
    """SAC that need not act at random while it fills its memory.

    With a demonstrator, the actor is held near what that would do, in any place of the memory: its loss is the one of
    SAC, measured in the mean absolute value that the critics give, plus `held` times the mean squared distance to the
    demonstrator's actions (Fujimoto and Gu, A Minimalist Approach to Offline Reinforcement Learning, 2021). Without
    that, critics that have seen little beside the demonstrations lead the actor astray.

    Attributes:
        acts_at_random: Whether it acts so while it fills its memory.
        demonstrator: Who acts then instead of mere chance.
        held: How much the actor is held near the demonstrator.
    """

    acts_at_random = True
    demonstrator: Demonstrator | None = None
    held = 0.0

    def _sample_action(self, learning_starts: int, action_noise: Any = None, n_envs: int = 1) -> Any:
        if not self.acts_at_random:
            return super()._sample_action(0, action_noise, n_envs)
        if self.demonstrator is None or self.num_timesteps >= learning_starts:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        actions = self.demonstrator.strewn(self._last_obs)  # actions of the environment lie within -1 and 1 as they are
        return actions, actions

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """So many gradient steps, in each of which the actor is held near the demonstrator, if there is one."""
        hold = self.actor.optimizer.register_step_pre_hook(lambda *_: self._hold(batch_size))
        try:
            super().train(gradient_steps, batch_size)
        finally:
            hold.remove()

    def _hold(self, count: int) -> None:
        """Add the pull towards the demonstrator to the gradients of SAC's actor loss, just before they are followed."""
        if self.demonstrator is None:
            return
        observed = self.demonstrator.places(self.replay_buffer, count)
        wish, done = self.demonstrator.wish(observed), self.actor(observed, deterministic=True)
        with torch.no_grad():
            worth = torch.cat(self.critic(observed, done), dim=1).abs().mean() + 1.0
        apart = ((done - wish) ** 2 * self.demonstrator.knows(observed)).mean()
        parameters = [part for group in self.actor.optimizer.param_groups for part in group["params"]]
        pulls = torch.autograd.grad(self.held * apart, parameters, allow_unused=True)
        for part, pull in zip(parameters, pulls, strict=True):
            if pull is not None and part.grad is not None:
                part.grad.div_(worth).add_(pull)
        self.logger.record("train/imitation_loss", apart.detach().item())
