"""Trained models as agents, by the folder of their training."""

from __future__ import annotations

from pathlib import Path

from greenhouse_gym.learning.ppo import load_ppo
from greenhouse_gym.learning.sac import load_sac
from greenhouse_gym.learning.sb3 import Sb3Agent
from greenhouse_gym.learning.training_files import read_notes


def load_agent(folder: str | Path) -> Sb3Agent:
    """Load the model of a training's folder as an agent, whose ``env_options`` are those of the training.

    Raises:
        FileFormatError: The checkpoint is missing or damaged.
    """
    path = Path(folder)
    model = load_sac(path, 1, memory=1) if read_notes(path)["algorithm"] == "SAC" else load_ppo(path, 1)
    model.get_env().close()
    return Sb3Agent(model, path.resolve().name)
