"""Tasks by name; each is one file."""

from collections.abc import Mapping
from types import MappingProxyType

from greenhouse_gym.envs.task import Task
from greenhouse_gym.envs.tasks.reach import TomatoReach

TASKS: Mapping[str, type[Task]] = MappingProxyType({"reach": TomatoReach})
"""Tasks by name."""

__all__ = ["TASKS", "TomatoReach"]
