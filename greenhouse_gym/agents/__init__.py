"""Agents: the protocol, planner and policy agents, simple baselines."""
