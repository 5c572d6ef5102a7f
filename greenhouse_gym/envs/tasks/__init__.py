"""Tasks by name; each is one file."""

from collections.abc import Mapping
from types import MappingProxyType

from greenhouse_gym.envs.task import Task
from greenhouse_gym.envs.tasks.harvest import TomatoHarvest
from greenhouse_gym.envs.tasks.reach import TomatoReach

TASKS: Mapping[str, type[Task]] = MappingProxyType({"reach": TomatoReach, "harvest": TomatoHarvest})
"""Tasks by name."""

__all__ = ["TASKS", "TomatoHarvest", "TomatoReach"]
