"""Training functions and policy files."""
