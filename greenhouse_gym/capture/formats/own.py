"""The package's own folders: ``recording.json`` next to the images it names."""

from __future__ import annotations

from pathlib import Path

from greenhouse_gym.capture.recordings import INDEX, open_folder

name = "greenhouse"
description = f"{INDEX} and the images it names"
open = open_folder


def recognizes(path: Path) -> bool:
    """Return whether the folder has an index."""
    return (path / INDEX).is_file()
