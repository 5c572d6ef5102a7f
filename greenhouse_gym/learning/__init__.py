"""Training: PPO on the vector environment, checkpoints, and policy files."""
