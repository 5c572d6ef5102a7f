"""The command line, ``greenhouse-gym``."""

from greenhouse_gym.cli.main import app, main

__all__ = ["app", "main"]
