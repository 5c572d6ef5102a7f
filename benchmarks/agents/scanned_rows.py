"""Banks of simulated rows for `true_rows.py`: grown, photographed by a protocol, reconstructed, and cut into scenes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from greenhouse_gym.build.scenes import BuildSettings, cut_scenes, provenance_of
from greenhouse_gym.capture import get_protocol, simulate_protocol
from greenhouse_gym.crops import CULTIVARS, STYLES, grow_row
from greenhouse_gym.reconstruction import reconstruct_row
from greenhouse_gym.scene import Provenance, Scene, SceneBank, Target
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.manifest import MANIFEST
from greenhouse_gym.shapes import extract_shapes

MARGIN = 0.25
"""Minimum distance between the arm and the first or last half spacing of the walk, m: nothing was scanned beyond."""


@dataclass(frozen=True)
class ScannedRow:
    """A row and how it is photographed and cut.

    Attributes:
        seed: Seed of the plants, the walk and the noise; week and style follow from it.
        source: "own" or "helios".
        protocol: Name of the capture protocol.
        length: Length of the row, m.
        spacing: Distance between neighboring arm placements, m.
    """

    seed: int
    source: str = "own"
    protocol: str = "paper"
    length: float = 2.0
    spacing: float = 0.5

    @property
    def name(self) -> str:
        """Name of the row's folder."""
        return f"{self.source}-{self.seed}-{self.length:g}m-{self.spacing:g}-{self.protocol}"

    def bank(self, workdir: Path) -> SceneBank:
        """Return the bank of the row's scenes with their truth; build it if necessary.

        Every tomato is a target, and its difficulty means nothing.
        """
        folder = workdir / self.name
        if not (folder / MANIFEST).exists():
            styles = list(STYLES if self.source == "own" else CULTIVARS)
            style, week = styles[(self.seed + self.seed // 3) % len(styles)], self.seed % 3
            row = grow_row(self.seed, self.length, week=week, style=style, source=self.source)
            recording = simulate_protocol(row, self.seed, get_protocol(self.protocol))
            recording = replace(recording, name=f"{self.source}-{self.seed}")
            build = BuildSettings(spacing=self.spacing)
            cloud = reconstruct_row(recording)
            shapes = extract_shapes(cloud.points, cloud.colors, cloud.normals)
            known = Provenance(row=recording.name, style=style, source=self.source)
            origin = provenance_of(recording, week, build, known)
            scenes = cut_scenes(cloud, shapes, recording, week, build, origin)
            ends = round(MARGIN / self.spacing)
            cut = [scene.model_copy(update={"targets": _targets(scene)}) for scene in scenes[ends : len(scenes) - ends]]
            write_bank(folder, [(scene, "test") for scene in cut], self.name)
        return SceneBank.open(folder)


def _targets(scene: Scene) -> tuple[Target, ...]:
    return tuple(Target(tomato=k, difficulty="easy") for k in range(len(scene.tomatoes)))


def row_seeds(text: str) -> list[int]:
    """Parse seeds of rows, such as "711-716" or "711,713"."""
    first, _, last = text.partition("-")
    return list(range(int(first), int(last) + 1)) if last else [int(part) for part in text.split(",")]
