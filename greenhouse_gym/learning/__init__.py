"""Training: PPO, imitation of a teacher before PPO, SAC with hindsight replay, checkpoints, and policy files."""

from greenhouse_gym.learning.bc_then_ppo import FINE_TUNING, BcThenPpoSettings, train_bc_then_ppo
from greenhouse_gym.learning.device_ppo import DevicePpoSettings, train_ppo_on_device
from greenhouse_gym.learning.policies import load_into, save_policy
from greenhouse_gym.learning.ppo import PpoSettings, load_ppo, train_ppo
from greenhouse_gym.learning.ppo_sweep import sweep_ppo
from greenhouse_gym.learning.sac import SacSettings, load_sac, train_sac
from greenhouse_gym.learning.trained import load_agent

__all__ = [
    "FINE_TUNING",
    "BcThenPpoSettings",
    "DevicePpoSettings",
    "PpoSettings",
    "SacSettings",
    "load_agent",
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
