"""SAC that begins as a guide, with what that does in its memory, and is held near it."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.observations import Layout
from greenhouse_gym.extras import needs

with needs("train"):
    import torch
    from stable_baselines3 import SAC

    from greenhouse_gym.learning.waypoint_weights import carry_waypoint

NOISIEST = 0.5
"""Standard deviation of the noise on guided actions, which go from -1 to 1, in the last of the simulations."""

CRITICS_ALONE = 5_000
"""Gradient steps before the actor changes, where it begins as the guide: untrained critics would lead it astray."""

_SPREAD = 0.1  # standard deviation of an untrained actor that begins as the guide, before its hyperbolic tangent


class Guide:
    """Goes where the waypoint of a goal environment says, as the agent ``waypoint`` does.

    Args:
        layout: Layout of the environment's ``"observation"``.
        seed: Seed of what is drawn.

    Attributes:
        random: Draws the noise on its actions.
    """

    def __init__(self, layout: Layout, seed: int):
        ends = np.cumsum([size for _, size in layout])
        at = {name: slice(int(end) - size, int(end)) for (name, size), end in zip(layout, ends, strict=True)}
        self._direction, self._free = at["waypoint_direction"], at["way"].start + 1
        self.random = np.random.default_rng(seed)

    def wish(self, observed: dict[str, Any]) -> Any:
        """(n, size) the actions of the agent, as arrays or tensors are observed."""
        seen = observed["observation"]
        return seen[:, self._direction] * seen[:, self._free : self._free + 1]

    def knows(self, observed: dict[str, Any]) -> Any:
        """(n,) 1 where it knows a way, else 0."""
        return observed["observation"][:, self._free]

    def strewn(self, observed: dict[str, Any]) -> npt.NDArray[np.float32]:
        """(n, size) these actions with noise: none in the first simulation, most in the last."""
        wish = self.wish(observed)
        spread = np.linspace(0.0, NOISIEST, len(wish))[:, None]
        return np.clip(wish + spread * self.random.normal(size=wish.shape), -1.0, 1.0).astype(np.float32)


class Demonstrated(SAC):  # type: ignore[misc]
    """SAC that need not act at random while it fills its memory.

    With a guide, the actor begins as that, and as many gradient steps of imitation follow those of SAC, in any place of
    the memory where the guide knows a way. Without them critics that have seen little beside what the guide does soon
    lead the actor astray (as Fujimoto and Gu say, A Minimalist Approach to Offline Reinforcement Learning, 2021).

    Attributes:
        acts_at_random: Whether it acts so while it fills its memory.
        guide: Who acts then instead of mere chance.
    """

    acts_at_random = True
    guide: Guide | None = None

    def begin_as_guide(self, layout: Layout, seed: int) -> None:
        """Have the untrained actor go where the guide says, but for what the hyperbolic tangent takes off.

        Raises:
            InvalidValueError: The actor is told no waypoint, its layers are too narrow, or it has other activations.
        """
        actor = self.actor
        layers = [layer for layer in actor.latent_pi if hasattr(layer, "in_features")]
        carry_waypoint(actor.features_extractor.scaled, layers, actor.mu, self.policy.activation_fn)
        with torch.no_grad():
            actor.log_std.weight.zero_()
            actor.log_std.bias.fill_(float(np.log(_SPREAD)))
        self.guide = Guide(layout, seed)
        self._imitator = torch.optim.Adam(actor.parameters(), lr=self.actor.optimizer.param_groups[0]["lr"])

    def _update_learning_rate(self, optimizers: Any) -> None:
        super()._update_learning_rate(optimizers)
        if self.guide is not None and self._n_updates < CRITICS_ALONE:
            for group in self.actor.optimizer.param_groups:
                group["lr"] = 0.0

    def _sample_action(self, learning_starts: int, action_noise: Any = None, n_envs: int = 1) -> Any:
        if not self.acts_at_random:
            return super()._sample_action(0, action_noise, n_envs)
        if self.guide is None or self.num_timesteps >= learning_starts:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        actions = self.guide.strewn(self._last_obs)  # actions of the environment lie within -1 and 1 as they are
        return actions, actions

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """So many gradient steps of SAC, and of imitation where there is a guide."""
        super().train(gradient_steps, batch_size)
        if self.guide is not None and self._n_updates > CRITICS_ALONE:
            losses = [self._imitate(self.guide, batch_size) for _ in range(gradient_steps)]
            self.logger.record("train/imitation_loss", float(np.mean(losses)))

    def _imitate(self, guide: Guide, count: int) -> float:
        """One gradient step towards the guide in places (count,) of the memory, and the loss before it."""
        memory = self.replay_buffer
        rows = guide.random.integers(memory.buffer_size if memory.full else memory.pos, size=count)
        places = rows, guide.random.integers(memory.n_envs, size=count)
        observed = {name: torch.as_tensor(part[places]) for name, part in memory.observations.items()}
        apart = (self.actor(observed, deterministic=True) - torch.tanh(guide.wish(observed))) ** 2
        loss = (apart.mean(dim=1) * guide.knows(observed)).mean()
        self._imitator.zero_grad()
        loss.backward()
        self._imitator.step()
        return float(loss.detach())
