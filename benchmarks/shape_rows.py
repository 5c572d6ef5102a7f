"""The rows that shapes.py measures: their recordings and clouds, made once and kept under a folder.

Folders carry a fingerprint of the sources that made what is in them, so nothing outdated is ever read.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import perfect_clouds
from perfect_clouds import NOISE_FREE, perfect_cloud

import greenhouse_gym
from greenhouse_gym.accuracy import Visibility, cut_stems, stem_visibility, tomato_visibility
from greenhouse_gym.capture import (
    SEED_RIG,
    Recording,
    WalkSettings,
    open_recording,
    simulate_recording,
    write_recording,
)
from greenhouse_gym.capture.recordings import INDEX
from greenhouse_gym.capture.simulated import walk
from greenhouse_gym.crop import Stem
from greenhouse_gym.geometry import Array
from greenhouse_gym.paths import write_atomically
from greenhouse_gym.plants import STYLES, PlantRow, grow_row
from greenhouse_gym.reconstruction import RowCloud, load_row, reconstruct_row, save_row

CAUSES = ("noisy", "noise-free")
"""Where a cloud comes from: `reconstruct_row` of a noisy recording, or perfect images merged at their true poses."""


@dataclass(frozen=True)
class Row:
    """A simulated row; week and style follow from the seed.

    Attributes:
        seed: Of the plants, the walk and the noise.
        length: Metres.
    """

    seed: int
    length: float = 2.0

    @property
    def week(self) -> int:
        """Growth week."""
        return self.seed % 3

    @property
    def style(self) -> str:
        """Fruit style; every style meets every week."""
        return list(STYLES)[(self.seed + self.seed // 3) % len(STYLES)]

    @property
    def name(self) -> str:
        """What its files are called."""
        return f"{self.length:g}m-{self.seed}-week{self.week}-{self.style}"

    def grow(self) -> PlantRow:
        """The truth."""
        return grow_row(self.seed, self.length, self.week, self.style)

    def poses(self) -> Array:
        """(stations, 4, 4) true poses of the rig."""
        return walk(len(self.simulate(NOISE_FREE)), self.seed, SEED_RIG, NOISE_FREE)

    def simulate(self, settings: WalkSettings | None = None) -> Recording:
        """Its recording, rendered as it is read."""
        return simulate_recording(self.grow(), self.seed, settings=settings)


def sources(*parts: str) -> str:
    """A fingerprint of some of the package's files, and of how clouds without noise are made."""
    package = Path(greenhouse_gym.__file__).parent
    files = [Path(perfect_clouds.__file__), package / "geometry.py", package / "crop.py"]
    files += [file for part in parts for file in sorted(package.glob(part))]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


def recording_of(row: Row, workdir: Path) -> Recording:
    """A row's noisy recording, read from disk."""
    folder = workdir / f"recordings-{sources('plants/*.py', 'capture/*.py')}" / row.name
    if not (folder / INDEX).exists():
        write_recording(row.simulate(), folder)
    return open_recording(folder)


def cloud_of(row: Row, cause: str, workdir: Path) -> RowCloud:
    """A row's cloud of one of the `CAUSES`, in the frame of its first registered station."""
    made = sources("plants/*.py", "capture/*.py", "reconstruction/*.py")
    file = workdir / f"clouds-{made}" / f"{row.name}-{cause}.npz"
    make: Callable[[], RowCloud] = {
        "noisy": lambda: reconstruct_row(recording_of(row, workdir)),
        "noise-free": lambda: perfect_cloud(row.simulate(NOISE_FREE)),
    }[cause]
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        save_row(make(), file)
    return load_row(file)


def visible_of(row: Row, workdir: Path) -> tuple[Visibility, tuple[Stem, ...]]:
    """How visible each tomato of a row is, and the visible pieces of its stems."""
    made = sources("plants/*.py", "capture/*.py", "accuracy/visibility.py")
    file = workdir / f"visible-{made}" / f"{row.name}.npz"
    truth = row.grow()
    cut = cut_stems(truth.stems)
    if not file.exists():
        poses = row.poses()
        tomatoes = tomato_visibility(truth, SEED_RIG, poses)
        stems = stem_visibility(truth, cut, SEED_RIG, poses)
        buffer = io.BytesIO()
        np.savez(buffer, in_image=tomatoes.in_image, whole=tomatoes.whole, stems=stems.visible)
        write_atomically(file, buffer.getvalue())
    with np.load(file) as stored:
        tomatoes = Visibility(stored["in_image"], stored["whole"])
        return tomatoes, tuple(cut.pieces[i] for i in np.flatnonzero(stored["stems"]))
