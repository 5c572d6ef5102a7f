"""Folders of trainings: nothing in them is overwritten, and what is resumed is the same training."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from greenhouse_gym.errors import InvalidValueError


def check_folder(
    marker: Path, made_with: Callable[[], Mapping[str, Any]], described: Mapping[str, Any], longer: str, resume: bool
) -> None:
    """Refuse to overwrite a training, to resume where there is none, and to resume one with other settings.

    Args:
        marker: The file in the folder that tells that there is a training.
        made_with: Reads the settings that it was made with.
        described: The settings asked for.
        longer: The one of them that may be another when a training is resumed.
        resume: Whether the training is to be resumed.

    Raises:
        InvalidValueError: As said above; the message names the folder, and the settings that differ.
    """
    folder = marker.parent
    if not marker.is_file():
        if resume:
            raise InvalidValueError(f"nothing to resume: {folder} holds no {marker.name}")
        return
    kept = made_with()
    if not resume:
        raise InvalidValueError(f"{folder} holds a training, which would be lost: resume it, or choose another folder")
    shared = [name for name in described if name != longer and name in kept]  # the others are newer than the training
    if different := [name for name in shared if kept[name] != described[name]]:
        raise InvalidValueError(f"the training in {folder} was made with other settings: {', '.join(different)}")
