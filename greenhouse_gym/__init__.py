"""Reinforcement learning and motion planning in reconstructed tomato greenhouses."""
