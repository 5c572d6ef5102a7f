"""Gymnasium's specification of an environment, with the step limit that the environment itself enforces."""

from __future__ import annotations

from gymnasium.envs.registration import EnvSpec

from greenhouse_gym.envs.settings import EnvSettings


class SpecMixin:
    """Property ``spec`` of the single and the vector environment.

    Attributes:
        settings: Settings of the environment.
    """

    settings: EnvSettings
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """Specification with which Gymnasium made the environment, with its step limit."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            spec.max_episode_steps = self.settings.step_limit
        self._spec = spec
