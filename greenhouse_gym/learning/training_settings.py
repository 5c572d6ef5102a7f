"""Types and checks of the settings that trainings share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Annotated, Any, TypeAlias

from pydantic import Field, InstanceOf

from greenhouse_gym.common.own_code import portable, with_absolute_path
from greenhouse_gym.common.settings_files import check_numbers
from greenhouse_gym.envs import Task
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.scene import Scene

Choice: TypeAlias = str | Mapping[str, Any] | Callable[..., Any] | InstanceOf[Task]
"""A name, ``"file.py:name"``, ``"module:name"``, an object, or a mapping with ``class`` and its fields."""

SceneChoice: TypeAlias = str | InstanceOf[Scene] | None

Seed = Annotated[int, Field(ge=0, lt=2**32)]  # as NumPy's global generator takes it
Simulations = Annotated[int, Field(ge=1, le=1 << 16)]
Threads = Annotated[int, Field(ge=0, le=1024)]
Layers = tuple[Annotated[int, Field(ge=1, le=1 << 14)], ...]
Rate = Annotated[float, Field(gt=0, allow_inf_nan=False)]

OWN = ("observation", "action", "reward", "task")
"""Settings that also take a user's own objects."""


def check_settings(settings: object) -> None:
    """Check the values of a dataclass of settings; turn lists into tuples and paths of own code into absolute ones.

    Raises:
        InvalidValueError: A value is out of its bounds or of another type, or a saved policy could not name an object.
    """
    for field in fields(settings):  # type: ignore[arg-type]
        value = getattr(settings, field.name)
        if isinstance(value, list):
            object.__setattr__(settings, field.name, tuple(value))
        elif field.name in OWN:
            object.__setattr__(settings, field.name, with_absolute_path(value))
    check_numbers(settings)
    for name in ("observation", "action", "task"):  # that a saved policy must state
        if hasattr(settings, name):
            portable(getattr(settings, name), name)


def require_joint_action(user: str, action: Choice) -> None:
    """Raise an error for actions of the tip, because waypoints are configurations.

    Raises:
        InvalidValueError: The action moves the tip.
    """
    if action == "tip_velocity":
        raise InvalidValueError(f'{user} follows waypoints of the joints: choose action="joint", got {action!r}')


def env_options(settings: Any) -> dict[str, Any]:
    """Return the keywords of the environment that is trained on, except those that only the trainers know."""
    names = ("bank", "robot", "difficulty", "observation", "action", "reward", "task", "scene", "target", "plants")
    return {name: getattr(settings, name) for name in names} | physics_of(settings)


def physics_of(settings: Any) -> dict[str, str]:
    """Return the physics that the plants of a training need, as a keyword of the environment."""
    return {"physics": "truth"} if settings.plants == "compliant" else {}
