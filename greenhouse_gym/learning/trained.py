"""Trained models as agents, by the folder of their training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from greenhouse_gym.learning.ppo import load_ppo
from greenhouse_gym.learning.sac import load_sac
from greenhouse_gym.learning.sb3 import Sb3Agent
from greenhouse_gym.learning.training_files import read_notes


class TrainedAgent(Sb3Agent):
    """The model of a training's folder as an agent; it is pickled as the path of the folder.

    Args:
        folder: Folder of the training.

    Raises:
        FileFormatError: The checkpoint is missing or damaged.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder).resolve()
        kind = read_notes(self.folder)["algorithm"]
        model = load_sac(self.folder, 1, memory=1) if kind == "SAC" else load_ppo(self.folder, 1)
        model.get_env().close()
        super().__init__(model, self.folder.name)

    def __reduce__(self) -> tuple[Any, ...]:
        return TrainedAgent, (self.folder,)
