"""Tasks by name; each is one file."""

from collections.abc import Mapping
from types import MappingProxyType

from greenhouse_gym.envs.task import Task
from greenhouse_gym.envs.tasks.harvest import HarvestReward, TomatoHarvest
from greenhouse_gym.envs.tasks.look import LookReward, TomatoLook
from greenhouse_gym.envs.tasks.reach import TomatoReach

TASKS: Mapping[str, type[Task]] = MappingProxyType({"reach": TomatoReach, "look": TomatoLook, "harvest": TomatoHarvest})
"""Tasks by name."""

__all__ = ["TASKS", "HarvestReward", "LookReward", "TomatoHarvest", "TomatoLook", "TomatoReach"]
