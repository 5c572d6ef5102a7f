"""The rows of `capture_protocols.py`: grown, photographed by a protocol, reconstructed and cut into scenes, once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

from greenhouse_gym.build.scenes import BuildSettings, cut_scenes
from greenhouse_gym.capture import get_protocol, simulate_protocol
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.crops import CULTIVARS, STYLES, PlantRow, grow_row
from greenhouse_gym.reconstruction import reconstruct_row
from greenhouse_gym.scene import Scene
from greenhouse_gym.shapes import FINE_SHAPES, ShapeSettings, extract_shapes

SCENES = "scenes.jsonl"


@dataclass(frozen=True)
class Options:
    """What is measured.

    Attributes:
        source: Where the plants come from.
        length: Of a row, metres.
        spacing: Between the stands of the arm, metres.
        robot: The arm.
        planner: The planner.
        checks: Its budget of collision checks.
        primitives: Most shapes in a scene.
        fine: Whether bent leaves become many small boxes, `greenhouse_gym.shapes.FINE_SHAPES`.
        per_scene: Most targets of a scene, drawn by the row's seed.
        moved: Whether the true plants have moved since they were scanned, in each episode elsewhere.
        leaves: How far from a leaf of meshes the boxes of its truth may lie, metres.
        margin: How far planned paths keep from boxes of clutter, metres.
        unexplained: Whether they keep out of where the scan saw a surface without a shape.
        workdir: Where scenes and episodes are kept.
    """

    source: str = "own"
    length: float = 2.0
    spacing: float = 0.5
    robot: str = "ur5e"
    planner: str = "RRTConnect"
    checks: int = 20_000
    primitives: int = 600
    fine: bool = False
    per_scene: int = 20
    moved: bool = False
    leaves: float = 0.02
    margin: float = 0.0
    unexplained: bool = False
    workdir: Path = Path("capture_protocols")


def folder_of(seed: int, protocol: str, options: Options) -> Path:
    """Where the scenes and episodes of a row and a protocol are kept."""
    made = f"{options.source}-{seed}-{options.length:g}m-{options.spacing:g}-{options.primitives}-{protocol}"
    exact = f"-{options.leaves:g}" * (options.leaves != Options.leaves)
    return options.workdir / (made + exact + "-fine" * options.fine)


def grow(seed: int, options: Options) -> PlantRow:
    """A row whose week and style follow from its seed."""
    styles = list(STYLES if options.source == "own" else CULTIVARS)
    style = styles[(seed + seed // 3) % len(styles)]
    return grow_row(seed, options.length, week=seed % 3, style=style, source=options.source)


def scenes_of(seed: int, protocol: str, options: Options) -> list[Scene]:
    """The scenes of a row, with the truth, made once."""
    file = folder_of(seed, protocol, options) / SCENES
    if not file.exists():
        began = perf_counter()
        row = grow(seed, options)
        recording = simulate_protocol(row, seed, get_protocol(protocol))
        cloud = reconstruct_row(recording)
        settings = FINE_SHAPES if options.fine else ShapeSettings()
        shapes = extract_shapes(cloud.points, cloud.colors, cloud.normals, settings)
        build = BuildSettings(max_shapes=options.primitives, spacing=options.spacing, leaf_tolerance=options.leaves)
        scenes = cut_scenes(cloud, shapes, recording, row.week, build)
        print(
            f"{protocol}, row {seed}: {cloud.registered.sum()} of {len(recording)} stations, {len(cloud)} points, "
            f"{[len(scene.obstacles) for scene in scenes]} shapes, {perf_counter() - began:.0f} s",
            flush=True,
        )
        write_atomically(file, "".join(scene.model_dump_json() + "\n" for scene in scenes))
    return scenes_in(file.parent)


def scenes_in(folder: Path) -> list[Scene]:
    """The scenes that were made of a row."""
    return [Scene.model_validate_json(line) for line in (folder / SCENES).read_text().splitlines()]
