"""Compare extracted shapes with the truth of simulated rows, from noisy recordings and from perfect clouds.

python -m benchmarks.sensing.shapes --workdir rows
python -m benchmarks.sensing.shapes --workdir rows --source helios [--held-out] --out shapes_helios.json

Ten held-out rows, whose seeds are used nowhere else; week and fruit style follow from the seed. Each is measured twice:
on the cloud that `reconstruct_row` makes of a noisy recording, and on perfect images merged at their true poses, which
separates errors of the extraction from errors of its input. ``--only noisy noisy-without-normals`` measures clouds with
and without their normals. Every measurement runs in its own process. Shapes are compared after a rigid alignment of the
row's cloud with the true surfaces, which removes most of the drift; centers of tomatoes are reported without it as
well.

Tomatoes match one to one within one true radius. A point on a stem's axis is found, or true, where an axis of the other
side lies within 10 mm and within 30 degrees of its direction; stems count by length. What was visible must be found;
what was hidden may be. Tomatoes (whole) and stems and leaves (in pieces of 2 cm) are visible if some image shows,
within 60 cm and with a depth, at least 30 % of the pixels that they alone would cover; the band at the image's edge
where a stereo camera measures no depth shows nothing. Other counts: "whole" compares with the silhouette beyond the
image's edge, "colored" includes the band without depth, and "measured" leaves out tomatoes with fewer than 10 points of
skin in the cloud.

Rows of organ meshes (``--source helios``) are development rows unless ``--held-out`` is given. They are compared with
the truth stored with their recordings, and their clouds are placed by the true pose of the middle station. Instead of
collisions, their boxes are measured: the fraction of their surface farther than 15 mm from all points, the fraction of
points farther than that from all shapes, and the fraction of found fruit whose front lies in a box.

Recordings, clouds and measurements are kept below --workdir under a fingerprint of the code that made them; a later run
measures only what is missing. Takes 90 minutes for own rows and 60 for Helios rows.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict, fields, replace
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from benchmarks.common import (
    RESULTS,
    add_workdir,
    fingerprint,
    in_own_process,
    kept_or_temporary,
    parser,
    write_results,
)
from benchmarks.sensing import perfect_clouds, shape_collisions
from benchmarks.sensing.rows import BARE, CAUSES, HELD_OUT_MESHES, Row, cloud_of, recording_of, truth_of, visible_of
from benchmarks.sensing.shape_collisions import compare_collisions
from benchmarks.sensing.shape_figures import box_figures, is_true, pooled, small_tomatoes, tables
from greenhouse_gym import accuracy, build, capture, crops, reconstruction, robots, scene
from greenhouse_gym import shapes as shapes_package
from greenhouse_gym.accuracy import StemComparison, TomatoComparison
from greenhouse_gym.build.scenes import BuildSettings, cut_scenes, placement_positions
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.crops.parts import STEM_KINDS
from greenhouse_gym.geometry import Array, Capsule, transform, transformed
from greenhouse_gym.geometry.point_clouds import Cloud
from greenhouse_gym.reconstruction import RowCloud
from greenhouse_gym.shapes import RowShapes, extract_shapes

HELD_OUT = range(401, 411)
DEVELOPMENT_MESHES = range(501, 507)
MIN_SKIN_POINTS = 10
"""Points of skin in the cloud below which a tomato counts as not measured; no sphere is fitted to fewer."""

CONFIGURATIONS = 3000
"""Random arm configurations per row and cause."""

Comparison = TypeVar("Comparison", TomatoComparison, StemComparison)


def measure(row: Row, cause: str, workdir: Path) -> dict[str, Any]:
    """Extract the shapes of a row's cloud and compare them with the truth; all figures in SI units."""
    cloud = cloud_of(row, cause, workdir)
    visible = visible_of(row, workdir)
    open3d()  # its import is not counted
    started, worked = time.perf_counter(), time.process_time()
    shapes = extract_shapes(cloud.points, cloud.colors, None if cause == BARE else cloud.normals)
    seconds, processor = time.perf_counter() - started, time.process_time() - worked

    known = truth_of(row, cloud, workdir)
    placed = in_frame(shapes, known.world_from_row)
    everything = placed.shapes
    points = transform(known.world_from_row, cloud.points)
    skin = accuracy.skin_points(
        Cloud(cloud.points, cloud.colors, cloud.normals).transformed(known.world_from_row), known.row.tomatoes
    )
    tomatoes = visible.tomatoes
    fractions = {
        "all": tomatoes.in_image,
        "whole": tomatoes.whole,  # parts beyond the image's edge count as hidden
        "measured": np.where(skin >= MIN_SKIN_POINTS, tomatoes.in_image, 0.0),
        "colored": tomatoes.in_color,  # the band without depth hides nothing
    }
    petioles = [shape for shape in known.row.clutter if isinstance(shape, Capsule)]
    unaligned = in_frame(shapes, known.world_from_station[np.flatnonzero(cloud.registered)[0]])
    true = known.row.tomatoes
    record = asdict(row) | {
        "cause": cause,
        "points": len(cloud),
        "shapes": {"tomatoes": len(shapes.tomatoes), "stems": len(shapes.stems), "clutter": len(shapes.clutter)},
        "tomatoes": {
            name: plain(accuracy.compare_tomatoes(true, tomatoes._replace(in_image=fraction), placed.tomatoes))
            for name, fraction in fractions.items()
        },
        "small_tomatoes": small_tomatoes(true, tomatoes.visible, placed.tomatoes),
        "confidence": [list(shapes.confidence), is_true(true, placed.tomatoes).tolist()],
        "unaligned_center_error": accuracy.match_tomatoes(true, unaligned.tomatoes).center_errors.tolist(),
        "stems": {
            kind: plain(accuracy.compare_stems(known.row.stems, visible.stems, petioles, placed.stems, kind))
            for kind in STEM_KINDS
        },
        "coverage": accuracy.coverage(points, everything),
        "boxes": box_figures(placed, points),
        "primitives": primitives(row, cloud, shapes, workdir),
        "seconds_per_metre": seconds / row.length,
        "processor_seconds_per_metre": processor / row.length,
    }
    if row.source == "own":
        stands = placement_positions(known.world_from_station[:, 1, 3], BuildSettings())
        record["excess"] = accuracy.excess(everything, known.row)
        record["collisions"] = compare_collisions(
            everything, known.row, visible, points, stands, CONFIGURATIONS, row.seed
        )._asdict()
    return record


def in_frame(shapes: RowShapes, target_from_source: Array) -> RowShapes:
    """Return the shapes in another frame."""
    return replace(
        shapes,
        tomatoes=tuple(tomato.transformed(target_from_source) for tomato in shapes.tomatoes),
        stems=tuple(transformed(stem, target_from_source) for stem in shapes.stems),
        clutter=tuple(transformed(box, target_from_source) for box in shapes.clutter),
    )


def primitives(row: Row, cloud: RowCloud, shapes: RowShapes, workdir: Path) -> list[int]:
    """Return the number of shapes in each scene of a row without the maximum per scene."""
    settings = replace(BuildSettings(), max_shapes=10**9)
    recording = recording_of(row, workdir)
    return [len(scene.obstacles) for scene in cut_scenes(cloud, shapes, recording, row.week, settings)]


def plain(comparison: Comparison) -> dict[str, Any]:
    """Return a comparison as values that JSON can hold."""
    values = {field.name: getattr(comparison, field.name) for field in fields(comparison)}
    return {name: value if isinstance(value, float) else value.tolist() for name, value in values.items()}


def measured(row: Row, cause: str, workdir: Path) -> dict[str, Any]:
    """Return the measurement of a row, kept under the fingerprint of the code; measure it if it is missing."""
    made = fingerprint(crops, capture, reconstruction, shapes_package, accuracy, scene, robots, build, perfect_clouds)
    here = fingerprint(sys.modules[__name__], shape_collisions)
    file = workdir / f"measured-{made}-{here}" / f"{row.name}-{cause}.json"
    if not file.exists():
        write_atomically(file, json.dumps(in_own_process(measure, row, cause, workdir)))
    record: dict[str, Any] = json.loads(file.read_text())
    return record


def main() -> None:
    """Measure what is missing, write the results, print tables."""
    command = parser(__doc__)
    command.add_argument("--source", choices=("own", "helios"), default="own", help="of the plants")
    command.add_argument("--held-out", action="store_true", help="the held-out rows of Helios' plants")
    command.add_argument("--seeds", type=int, nargs="+", help="by default the held-out own rows, or see above")
    command.add_argument("--length", type=float, default=2.0, help="of each row, m")
    command.add_argument("--only", nargs="+", choices=(*CAUSES, BARE), default=list(CAUSES))
    add_workdir(command)
    command.add_argument("--out", type=Path, default=RESULTS / "shapes.json")
    a = command.parse_args()
    meshes = HELD_OUT_MESHES if a.held_out else DEVELOPMENT_MESHES
    seeds = a.seeds or list(HELD_OUT if a.source == "own" else meshes)
    records = []
    with kept_or_temporary(a.workdir) as folder:
        for seed, cause in product(seeds, a.only):
            row = Row(seed, a.length, a.source)
            records.append(measured(row, cause, folder))
            print(f"{row.name} {cause}: done", flush=True)
    figures = {cause: pooled([r for r in records if r["cause"] == cause]) for cause in a.only}
    rows = {f"{r['seed']} {r['cause']}": pooled([r]) for r in records}
    write_results(a.out, {"source": a.source, "seeds": seeds, "length": a.length, "figures": figures, "rows": rows})
    print(tables(figures))


if __name__ == "__main__":
    main()
