"""SAC that begins with demonstrations, and imitates them where its critics think them better than what it does."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.observations import Layout
from greenhouse_gym.extras import needs

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
        ends = np.cumsum([size for _, size in layout])
        at = {name: slice(int(end) - size, int(end)) for (name, size), end in zip(layout, ends, strict=True)}
        self._direction, self._free = at["waypoint_direction"], at["way"].start + 1
        self._random = np.random.default_rng(seed)

    def wish(self, observed: dict[str, Any]) -> Any:
        """(n, size) the actions of the agent, as arrays or tensors are observed."""
        seen = observed["observation"]
        return seen[:, self._direction] * seen[:, self._free : self._free + 1]

    def strewn(self, observed: dict[str, Any]) -> npt.NDArray[np.float32]:
        """(n, size) these actions with noise: none in the first simulation, most in the last."""
        wish = self.wish(observed)
        spread = np.linspace(0.0, NOISIEST, len(wish))[:, None]
        return np.clip(wish + spread * self._random.normal(size=wish.shape), -1.0, 1.0).astype(np.float32)


class Demonstrated(SAC):  # type: ignore[misc]
    """SAC that need not act at random while it fills its memory.

    With a demonstrator, what it observes then is kept, and after the gradient steps of SAC as many of imitation follow,
    all towards what the demonstrator would do there, but only where the critics think that better than what the actor
    would do (the filter of Nair et al., Overcoming Exploration in Reinforcement Learning with Demonstrations, 2018).

    Attributes:
        acts_at_random: Whether it acts so while it fills its memory.
        demonstrator: Who acts then instead of mere chance.
    """

    acts_at_random = True
    demonstrator: Demonstrator | None = None

    def __init__(self, *arguments: Any, **keywords: Any):
        self._shown: list[dict[str, npt.NDArray[Any]]] = []
        self._demonstrations: dict[str, Any] = {}
        super().__init__(*arguments, **keywords)

    def _sample_action(self, learning_starts: int, action_noise: Any = None, n_envs: int = 1) -> Any:
        if not self.acts_at_random:
            return super()._sample_action(0, action_noise, n_envs)
        if self.demonstrator is None or self.num_timesteps >= learning_starts:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        self._shown.append({name: part.copy() for name, part in self._last_obs.items()})
        actions = self.demonstrator.strewn(self._last_obs)  # actions of the environment lie within -1 and 1 as they are
        return actions, actions

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """So many gradient steps of SAC, and of imitation."""
        super().train(gradient_steps, batch_size)
        if self._shown:
            names = self._shown[0]
            self._demonstrations = {
                name: torch.as_tensor(np.concatenate([each[name] for each in self._shown])) for name in names
            }
            self._shown = []
        if self._demonstrations:
            for _ in range(gradient_steps):
                self._imitate(batch_size)

    def _imitate(self, count: int) -> None:
        assert self.demonstrator is not None
        rows = torch.randint(len(self._demonstrations["observation"]), (count,))
        observed = {name: part[rows] for name, part in self._demonstrations.items()}
        wish, done = self.demonstrator.wish(observed), self.actor(observed, deterministic=True)
        with torch.no_grad():
            wished, own = (torch.cat(self.critic(observed, action), dim=1).min(dim=1)[0] for action in (wish, done))
        loss = (((done - wish) ** 2).mean(dim=1) * (wished > own)).mean()
        self.actor.optimizer.zero_grad()
        loss.backward()
        self.actor.optimizer.step()
        self.logger.record("train/imitation_loss", loss.detach().item())
