"""How right extracted shapes are against the truth of simulated rows, from noisy recordings and from perfect clouds.

python benchmarks/shapes.py --workdir rows
python benchmarks/shapes.py --workdir rows --source helios [--held-out] --out benchmarks/results/shapes_helios.json

Ten held-out rows: their seeds are used nowhere else; week and fruit style follow from the seed. Each is measured twice:
on the cloud that `reconstruct_row` makes of a noisy recording, and on perfect images merged at their true poses, which
separates what extraction gets wrong from what it was given wrong. With ``--only noisy noisy-without-normals`` the first
is measured with and without its normals, as a cloud of somebody else's may come. Every measurement runs in a process of
its own. Shapes are compared after one rigid alignment of the row's cloud with the true surfaces, which takes most of
the drift out (the tomatoes' centers are given without it as well).

Tomatoes match within one true radius, one to one. A place on a stem's axis counts as found, or as true, where an axis
of the other side lies within 10 mm and runs within 30 degrees of it; stems count by length. Only what was visible must
be found, and what was hidden may be: tomatoes as a whole, stems and leaves in pieces of 2 cm, visible if some frame
shows at least 30 % of the pixels that they alone would cover in it, after the cut at 60 cm and with a depth: the band
along the image's side in which a stereo camera measures none shows nothing. Tomatoes are also counted with this band,
and without those of whose skin the cloud holds fewer than 10 points, such as what the right imager of a stereo camera
does not see.

Rows of Helios' plants (``--source helios``) are development rows unless ``--held-out`` is given, and are measured by
the truth that lies beside their recordings; their clouds are placed by the true pose of the middle station. Instead of
collisions, the boxes are measured: how much of their surface lies farther than 15 mm from all points, how many points
lie farther than that from all shapes, and how many fruits found have their front in a box.

Recordings, clouds and measurements are kept under --workdir, by a fingerprint of the sources that made them; started
again, the benchmark goes on with what is missing.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, fields, replace
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from results_file import RESULTS, write_results
from shape_boxes import box_figures
from shape_collisions import compare_collisions
from shape_confidence import credited, small_tomatoes
from shape_rows import BARE, CAUSES, HELD_OUT_MESHES, Row, cloud_of, recording_of, sources, truth_of, visible_of
from shape_tables import pooled, tables

from greenhouse_gym.accuracy import (
    StemComparison,
    TomatoComparison,
    compare_stems,
    compare_tomatoes,
    coverage,
    excess,
    match_tomatoes,
    skin_points,
)
from greenhouse_gym.build.scenes import BuildSettings, cut_scenes, placement_positions
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.crops.parts import STEM_KINDS
from greenhouse_gym.geometry import Array, Capsule, transform, transformed
from greenhouse_gym.reconstruction import RowCloud
from greenhouse_gym.reconstruction.point_clouds import Cloud
from greenhouse_gym.shapes import RowShapes, extract_shapes

HELD_OUT = range(401, 411)
DEVELOPMENT_MESHES = range(501, 507)
FEWEST_POINTS = 10
"""Points of skin in the cloud without which a tomato counts as not measured; no sphere is fitted to fewer."""

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
    whole = visible.tomatoes._replace(in_image=visible.tomatoes.whole)  # beyond the image's edge counts as hidden
    colored = visible.tomatoes._replace(in_image=visible.tomatoes.in_color)  # the band without depth hides nothing
    skin = skin_points(
        Cloud(cloud.points, cloud.colors, cloud.normals).transformed(known.world_from_row), known.row.tomatoes
    )
    in_cloud = np.where(skin >= FEWEST_POINTS, visible.tomatoes.in_image, 0.0)
    measured = visible.tomatoes._replace(in_image=in_cloud)  # what no depth was measured of counts as hidden
    petioles = [shape for shape in known.row.clutter if isinstance(shape, Capsule)]
    unaligned = in_frame(shapes, known.world_from_station[np.flatnonzero(cloud.registered)[0]])
    true = known.row.tomatoes
    record = asdict(row) | {
        "cause": cause,
        "points": len(cloud),
        "shapes": {"tomatoes": len(shapes.tomatoes), "stems": len(shapes.stems), "clutter": len(shapes.clutter)},
        "tomatoes": plain(compare_tomatoes(true, visible.tomatoes, placed.tomatoes)),
        "whole_tomatoes": plain(compare_tomatoes(true, whole, placed.tomatoes)),
        "measured_tomatoes": plain(compare_tomatoes(true, measured, placed.tomatoes)),
        "colored_tomatoes": plain(compare_tomatoes(true, colored, placed.tomatoes)),
        "small_tomatoes": small_tomatoes(true, visible.tomatoes.visible, placed.tomatoes),
        "confidence": [list(shapes.confidence), credited(true, placed.tomatoes)],
        "unaligned_center_error": match_tomatoes(true, unaligned.tomatoes).center_errors.tolist(),
        "stems": {
            kind: plain(compare_stems(known.row.stems, visible.stems, petioles, placed.stems, kind))
            for kind in STEM_KINDS
        },
        "coverage": coverage(points, everything),
        "boxes": box_figures(placed, points),
        "primitives": primitives(row, cloud, shapes, workdir),
        "seconds_per_metre": seconds / row.length,
        "processor_seconds_per_metre": processor / row.length,
    }
    if row.source == "own":
        stands = placement_positions(known.world_from_station[:, 1, 3], BuildSettings())
        record["excess"] = excess(everything, known.row)
        record["collisions"] = compare_collisions(
            everything, known.row, visible, points, stands, CONFIGURATIONS, row.seed
        )._asdict()
    return record


def in_frame(shapes: RowShapes, target_from_source: Array) -> RowShapes:
    """Shapes expressed in another frame."""
    return replace(
        shapes,
        tomatoes=tuple(tomato.transformed(target_from_source) for tomato in shapes.tomatoes),
        stems=tuple(transformed(stem, target_from_source) for stem in shapes.stems),
        clutter=tuple(transformed(box, target_from_source) for box in shapes.clutter),
    )


def primitives(row: Row, cloud: RowCloud, shapes: RowShapes, workdir: Path) -> list[int]:
    """Number of primitives in each scene of a row, were it not capped."""
    settings = replace(BuildSettings(), max_shapes=10**9)
    recording = recording_of(row, workdir)
    return [len(scene.obstacles) for scene in cut_scenes(cloud, shapes, recording, row.week, settings)]


def plain(comparison: Comparison) -> dict[str, Any]:
    """A comparison as JSON has it."""
    values = {field.name: getattr(comparison, field.name) for field in fields(comparison)}
    return {name: value if isinstance(value, float) else value.tolist() for name, value in values.items()}


def measured(row: Row, cause: str, workdir: Path) -> dict[str, Any]:
    """The measurement of a row, made unless it is there."""
    parts = ("plants", "capture", "reconstruction", "shapes", "accuracy", "scene", "robots")
    here = Path(__file__).parent
    made = sources(*(f"{part}/*" for part in parts), "build.py", here / "shapes.py", here / "shape_collisions.py")
    file = workdir / f"measured-{made}" / f"{row.name}-{cause}.json"
    if not file.exists():
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            write_atomically(file, json.dumps(pool.submit(measure, row, cause, workdir).result()))
    record: dict[str, Any] = json.loads(file.read_text())
    return record


def main() -> None:
    """Measure what is missing, write the results, print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", choices=("own", "helios"), default="own", help="of the plants")
    parser.add_argument("--held-out", action="store_true", help="the held-out rows of Helios' plants")
    parser.add_argument("--seeds", type=int, nargs="+", help="by default the held-out own rows, or see above")
    parser.add_argument("--length", type=float, default=2.0, help="of each row, metres")
    parser.add_argument("--only", nargs="+", choices=(*CAUSES, BARE), default=list(CAUSES))
    parser.add_argument("--workdir", type=Path, help="where to keep everything that is made; by default none is kept")
    parser.add_argument("--out", type=Path, default=RESULTS / "shapes.json")
    arguments = parser.parse_args()
    if arguments.seeds is None:
        meshes = HELD_OUT_MESHES if arguments.held_out else DEVELOPMENT_MESHES
        arguments.seeds = list(HELD_OUT if arguments.source == "own" else meshes)
    records = []
    with nullcontext(arguments.workdir) if arguments.workdir else tempfile.TemporaryDirectory() as folder:
        for seed, cause in product(arguments.seeds, arguments.only):
            row = Row(seed, arguments.length, arguments.source)
            records.append(measured(row, cause, Path(folder)))
            print(f"{row.name} {cause}: done", flush=True)
    figures = {cause: pooled([r for r in records if r["cause"] == cause]) for cause in arguments.only}
    write_results(
        arguments.out,
        {
            "source": arguments.source,
            "seeds": arguments.seeds,
            "length": arguments.length,
            "figures": figures,
            "rows": per_row(records),
        },
        ["open3d", "scipy"],
    )
    print(tables(figures))


def per_row(records: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of every single row."""
    return {f"{r['seed']} {r['cause']}": pooled([r]) for r in records}


if __name__ == "__main__":
    main()
