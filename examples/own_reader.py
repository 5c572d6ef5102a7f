"""Your own recording format: the folders image/ and range/, and a text file of intrinsics.

python examples/own_reader.py FOLDER

A package registers it for `open_recording` and the command line by an entry point in its pyproject.toml:

    [project.entry-points."greenhouse_gym.formats"]
    pairs = "my_package.own_reader"
"""

import sys
from pathlib import Path

from greenhouse_gym.capture import Intrinsics, Recording, open_recording, single_camera

name = "pairs"
description = "the folders image/ and range/ (tenths of a millimetre) and camera.txt: width height fx fy cx cy"


def recognizes(path: Path) -> bool:
    """Return whether the folder has ranges and intrinsics."""
    return (path / "range").is_dir() and (path / "camera.txt").is_file()


def open(path: Path) -> Recording:
    """Return the recording; the images of a station are read on access."""
    width, height, *pinhole = map(float, (path / "camera.txt").read_text().split())
    color, depth = (sorted((path / kind).glob("*.png")) for kind in ("image", "range"))
    return single_camera(path, Intrinsics(int(width), int(height), *pinhole), color, depth, depth_scale=1e-4)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(f"usage: python {sys.argv[0]} FOLDER, with {description}")
    recording = open_recording(sys.argv[1], format=sys.modules[__name__])
    points = recording[0].frames["camera"].points()
    print(f"{len(recording)} stations, {len(points)} points at the first, {points[:, 2].mean():.2f} m away")
