"""Reinforcement learning and motion planning in reconstructed tomato greenhouses.

Importing the package registers its environments with Gymnasium; everything else is imported when it is used.
"""

import gymnasium

from greenhouse_gym.common.opengl_choice import drop_broken_opengl_choice

__version__ = "0.1.0"

ENV_IDS: tuple[str, ...] = ("TomatoReach-v0", "TomatoLook-v0", "TomatoHarvest-v0")
"""Ids of the environments this package registers."""

drop_broken_opengl_choice()
_TASKS: tuple[dict[str, str], ...] = (
    {},
    {"task": "look", "observation": "task"},
    {"task": "harvest", "plants": "compliant", "physics": "truth"},
)
for _id, _keywords in zip(ENV_IDS, _TASKS, strict=True):
    gymnasium.register(
        id=_id,
        entry_point="greenhouse_gym.envs.environment:GreenhouseEnv",
        vector_entry_point="greenhouse_gym.envs.factory:make_vec",
        kwargs=_keywords,
    )

__all__ = ["ENV_IDS", "__version__"]
