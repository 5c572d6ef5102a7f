"""Training: PPO on the vector environment, checkpoints, and policy files."""

from greenhouse_gym.learning.policies import save_policy, score
from greenhouse_gym.learning.ppo import PpoSettings, train_ppo

__all__ = ["PpoSettings", "save_policy", "score", "train_ppo"]
