"""Training: PPO, SAC with hindsight replay, checkpoints, and policy files."""

from greenhouse_gym.learning.policies import save_policy
from greenhouse_gym.learning.ppo import PpoSettings, train_ppo
from greenhouse_gym.learning.sac import SacSettings, train_sac

__all__ = ["PpoSettings", "SacSettings", "save_policy", "train_ppo", "train_sac"]
