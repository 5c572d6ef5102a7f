"""Gymnasium's description of how an environment was made, with the step limit that the environment itself keeps."""

from __future__ import annotations

from gymnasium.envs.registration import EnvSpec

from greenhouse_gym.envs.settings import EnvSettings


class SpecMixin:
    """Gives an environment, single or vector, the property ``spec``.

    Attributes:
        settings: What the environment is made of.
    """

    settings: EnvSettings
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """How Gymnasium made the environment, with its step limit."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            spec.max_episode_steps = self.settings.step_limit
        self._spec = spec
