"""Simulated rows on which shapes are measured: their recordings, clouds and truth, made once and kept in a folder.

Folders carry a fingerprint of the code that made their content, so outdated content is never read.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.common import fingerprint
from benchmarks.sensing import perfect_clouds
from benchmarks.sensing.perfect_clouds import NOISE_FREE, perfect_cloud
from greenhouse_gym import accuracy, capture, crops, geometry, reconstruction
from greenhouse_gym.accuracy import Visibility, VisibleRow, align, visible_row
from greenhouse_gym.capture import SEED_RIG, Light, Recording, open_recording, simulate_recording, write_recording
from greenhouse_gym.capture.formats.own import INDEX
from greenhouse_gym.capture.simulated import CaptureSettings, tripod_poses
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.crops import DEVELOPMENT_CULTIVARS, HELD_OUT_CULTIVARS, STYLES, PlantRow, grow_row
from greenhouse_gym.crops.cultivars import RED, Cultivar
from greenhouse_gym.geometry import Array, invert
from greenhouse_gym.reconstruction import RowCloud, load_row, reconstruct_row, save_row
from greenhouse_gym.scene.obstacles import Shapes

CAUSES = ("noisy", "noise-free")
"""Origins of a cloud: `reconstruct_row` of a noisy recording, or perfect images merged at their true poses."""

BARE = "noisy-without-normals"
"""The noisy cloud without its normals."""

HELD_OUT_MESHES = range(601, 611)
"""Seeds of held-out rows of Helios' plants."""

DRAWN_MESHES = range(901, 931)
"""Seeds of rows of Helios' plants with random cultivars; networks are fitted to them, and nothing is measured."""

CHOICE_MESHES = range(931, 961)
"""Seeds of more such rows, by which settings may be chosen; nothing is fitted to them."""

LIGHTS = {
    "overcast": Light(sun=0.0, diffuse=1.0, gloss=0.3),
    "low sun behind the cameras": Light(azimuth=float(np.pi), elevation=0.35, sun=1.2, diffuse=0.6, gloss=0.8),
    "low sun against the cameras": Light(azimuth=0.0, elevation=0.35, sun=1.2, diffuse=0.6, gloss=0.8),
    "passing clouds": Light(sun=1.0, diffuse=0.7, flicker=0.4),
    "warm and overexposed": Light(exposure=1.6, white_balance=(1.12, 1.0, 0.82)),
    "cold and dark": Light(exposure=0.55, white_balance=(0.88, 1.0, 1.18)),
}
"""Light in which a row of organs may be photographed, by name."""


_CAPTURED = (geometry, crops, capture)

_SMALL = 0.35
"""Fraction of cultivars with cherry tomatoes."""


@dataclass(frozen=True)
class Row:
    """A simulated row; week and style follow from the seed.

    Attributes:
        seed: Seed of the plants, the walk and the noise; those of `HELD_OUT_MESHES` are of held-out cultivars.
        length: Length, m.
        source: Source of the plants, as in `grow_row`.
        light: One of `LIGHTS`; None for a light that follows from the seed.
    """

    seed: int
    length: float = 2.0
    source: str = "own"
    light: str | None = None

    @property
    def week(self) -> int:
        """Growth week."""
        return self.seed % 3

    @property
    def style(self) -> str:
        """Fruit style; every style meets every week."""
        if self.source == "helios" and self.seed in (*DRAWN_MESHES, *CHOICE_MESHES):
            return "drawn"
        if self.source == "helios":
            cultivars = list(HELD_OUT_CULTIVARS if self.seed in HELD_OUT_MESHES else DEVELOPMENT_CULTIVARS)
            return cultivars[(self.seed - 1) % 100 % len(cultivars)]
        return list(STYLES)[(self.seed + self.seed // 3) % len(STYLES)]

    @property
    def name(self) -> str:
        """Name of its files."""
        source = "" if self.source == "own" else f"{self.source}-"
        return f"{source}{self.length:g}m-{self.seed}-week{self.week}-{self.style}" + (
            f"-{self.light.replace(' ', '-')}" if self.light else ""
        )

    def grow(self) -> PlantRow:
        """Return the true row."""
        style = drawn_cultivar(self.seed) if self.style == "drawn" else self.style
        return grow_row(self.seed, self.length, self.week, style, source=self.source)

    def poses(self) -> Array:
        """(stations, 4, 4) true poses of the rig."""
        return tripod_poses(len(self.simulate(NOISE_FREE)), self.seed, SEED_RIG, NOISE_FREE)

    def simulate(self, settings: CaptureSettings | None = None) -> Recording:
        """Return its recording, rendered when it is read."""
        light = LIGHTS[self.light] if self.light else None
        return simulate_recording(self.grow(), self.seed, settings=settings, light=light)


def recording_of(row: Row, workdir: Path) -> Recording:
    """Return a row's noisy recording from disk."""
    folder = workdir / f"recordings-{fingerprint(*_CAPTURED)}" / row.name
    if not (folder / INDEX).exists():
        write_recording(row.simulate(), folder)
    return open_recording(folder)


def cloud_of(row: Row, cause: str, workdir: Path) -> RowCloud:
    """Return a row's cloud of one of the `CAUSES` or `BARE`, in the frame of its first registered station."""
    cause = "noisy" if cause == BARE else cause
    file = workdir / f"clouds-{fingerprint(*_CAPTURED, reconstruction, perfect_clouds)}" / f"{row.name}-{cause}.npz"
    make: Callable[[], RowCloud] = {
        "noisy": lambda: reconstruct_row(recording_of(row, workdir)),
        "noise-free": lambda: perfect_cloud(row.simulate(NOISE_FREE)),
    }[cause]
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        save_row(make(), file)
    return load_row(file)


class Known(NamedTuple):
    """A true row, the true poses (stations, 4, 4) of the rig, and the pose (4, 4) of a cloud's frame in the world."""

    row: PlantRow
    world_from_station: Array
    world_from_row: Array


def truth_of(row: Row, cloud: RowCloud, workdir: Path) -> Known:
    """Return the truth of a row; for rows of meshes, which grow slowly, it is read from the recording's folder."""
    if row.source == "own":
        truth, poses = row.grow(), row.poses()
        return Known(truth, poses, align(cloud, truth, poses))
    recording = recording_of(row, workdir)
    assert recording.truth is not None
    poses = np.array([station.world_from_station for station in recording])
    registered = np.flatnonzero(cloud.registered)
    middle = registered[len(registered) // 2]
    return Known(recording.truth, poses, poses[middle] @ invert(cloud.world_from_station[middle]))


def visible_of(row: Row, workdir: Path) -> VisibleRow:
    """Return the parts of a row that its recording could show."""
    folder = workdir / f"visible-{fingerprint(*_CAPTURED, accuracy)}"
    row = replace(row, light=None)  # the same things are in front of the cameras in any light
    fractions, pieces = folder / f"{row.name}.npy", folder / f"{row.name}.json"
    if not (fractions.exists() and pieces.exists()):
        visible = visible_row(row.grow(), SEED_RIG, row.poses())
        buffer = io.BytesIO()
        np.save(buffer, np.stack(visible.tomatoes))
        write_atomically(fractions, buffer.getvalue())
        write_atomically(pieces, Shapes(stems=visible.stems, clutter=visible.clutter).model_dump_json())
    shapes = Shapes.model_validate_json(pieces.read_bytes())
    return VisibleRow(Visibility(*np.load(fractions)), shapes.stems, shapes.clutter)


def drawn_cultivar(seed: int) -> Cultivar:
    """Sample a cultivar: fruit from cherry to beefsteak, flat to long, with more or less foliage.

    Sizes, counts and colors lie within published ranges; the deviation of colors from `RED` is a guess.
    """
    rng = np.random.default_rng([seed, 77])
    fruit = _fruit(rng)
    form = str(rng.choice(["oblate", "round", "long"], p=[0.35, 0.4, 0.25]))
    aspect = {"oblate": rng.uniform(0.65, 0.85), "round": rng.uniform(0.86, 1.0), "long": rng.uniform(1.15, 1.5)}[form]
    skin = tuple(_shade(color, rng) for color in RED)
    leaf_area, curl, stem = (float(rng.uniform(*ends)) for ends in ((1.0, 2.3), (-0.6, -0.15), (0.0038, 0.0065)))
    peduncle = float(rng.uniform(0.0011, 0.0016))
    side_shoots, ribs = float(rng.uniform(0.0, 0.15)), float(rng.uniform(0.0, 0.12 if form == "oblate" else 0.03))
    return Cultivar(
        model=str(rng.choice(["tomato", "cherrytomato"])),
        **fruit,
        aspect=(float(aspect), float(aspect) + 0.13),
        ribs=(0.4 * ribs, ribs),
        skin=skin,
        rachis=float(rng.uniform(0.11, 0.20)),
        peduncle_radius=(peduncle, 1.45 * peduncle),
        stem_radius=(stem, stem + 0.003),
        leaf_area=leaf_area,
        leaf_redness=(-0.33, -0.05),
        leaf_curl=(curl, curl + 0.27),
        leaf_width=float(rng.uniform(0.42, 0.68)),
        bare_below=float(rng.uniform(1.0, 1.25)),
        side_shoots=side_shoots,
    )


def _fruit(rng: np.random.Generator) -> dict[str, Any]:
    """Sample the number of fruits on a truss and their diameter."""
    small = rng.random() < _SMALL
    middle = float(np.exp(rng.uniform(*np.log((0.022, 0.034) if small else (0.034, 0.088)))))
    spread = rng.uniform(0.10, 0.20)
    low = int(rng.integers(7, 11) if small else rng.integers(2, 5))
    count = (low, low + int(rng.integers(4, 10) if small else rng.integers(1, 4)))
    return {"diameter": (middle * (1 - spread), middle * (1 + spread)), "count": count}


def _shade(color: tuple[float, float, float], rng: np.random.Generator) -> tuple[float, float, float]:
    red, green, blue = np.clip(np.array(color) * (1 + rng.normal(0, 0.06, 3)), 0.03, 0.95).tolist()
    return red, green, blue
