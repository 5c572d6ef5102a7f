"""Specification, pickles, copies and text that all environments have in common."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from gymnasium.envs.registration import EnvSpec

from greenhouse_gym.envs.choices import step_limit_of
from greenhouse_gym.envs.settings import EnvSettings


class EnvMixin:
    """Specification, pickles, copies and text of the single and the vector environment.

    A pickled environment becomes a new one with the same settings and random numbers, before its first reset. A copy is
    in the same state.

    Attributes:
        settings: Settings of the environment.
        options: Further keywords of its constructor.
    """

    settings: EnvSettings
    options: Mapping[str, Any]
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """Specification with which Gymnasium made the environment, with its step limit."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            spec.max_episode_steps = step_limit_of(self.settings)
            given = {name: value for name, value in spec.kwargs.items() if name != "settings"}
            spec.kwargs = given | self.settings.spec().kwargs  # own objects by reference, so that JSON holds it
        self._spec = spec

    def __reduce__(self) -> tuple[Any, ...]:
        kept = ("_spec", "_np_random", "_np_random_seed", "_rngs")
        return (
            _made_again,
            (type(self), self.settings, self.options),
            {k: v for k, v in vars(self).items() if k in kept},
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        twin = memo[id(self)] = object.__new__(type(self))
        twin.__dict__ = copy.deepcopy(self.__dict__, memo)
        return twin

    def __repr__(self) -> str:
        options = {name: value for name, value in self.options.items() if value is not None}
        given = ", ".join(f"{name}={value!r}" for name, value in (self.settings.keywords() | options).items())
        return f"{type(self).__name__}({given})"


def _made_again(kind: Any, settings: EnvSettings, options: Mapping[str, Any]) -> Any:
    return kind(settings=settings, **options)
