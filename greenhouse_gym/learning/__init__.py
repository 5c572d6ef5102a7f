"""Training: PPO, imitation of a teacher before PPO, SAC with hindsight replay, checkpoints, and policy files."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from greenhouse_gym.learning.device_training import train_ppo_on_device
    from greenhouse_gym.learning.imitation import train_bc_then_ppo
    from greenhouse_gym.learning.policies import load_into, save_policy
    from greenhouse_gym.learning.ppo import load_ppo, train_ppo
    from greenhouse_gym.learning.ppo_sweep import sweep_ppo
    from greenhouse_gym.learning.sac import load_sac, train_sac
    from greenhouse_gym.learning.settings import (
        FINE_TUNING,
        BcThenPpoSettings,
        DevicePpoSettings,
        PpoSettings,
        SacSettings,
    )
    from greenhouse_gym.learning.trained import TrainedAgent

_MODULES = {
    "device_training": ("train_ppo_on_device",),
    "imitation": ("train_bc_then_ppo",),
    "policies": ("load_into", "save_policy"),
    "ppo": ("load_ppo", "train_ppo"),
    "ppo_sweep": ("sweep_ppo",),
    "sac": ("load_sac", "train_sac"),
    "settings": ("FINE_TUNING", "BcThenPpoSettings", "DevicePpoSettings", "PpoSettings", "SacSettings"),
    "trained": ("TrainedAgent",),
}

__all__ = [
    "FINE_TUNING",
    "BcThenPpoSettings",
    "DevicePpoSettings",
    "PpoSettings",
    "SacSettings",
    "TrainedAgent",
    "load_into",
    "load_ppo",
    "load_sac",
    "save_policy",
    "sweep_ppo",
    "train_bc_then_ppo",
    "train_ppo",
    "train_ppo_on_device",
    "train_sac",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is used: settings are checked before PyTorch is imported, which takes seconds."""
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
