"""Measure the distance between the truth's collision shapes and the surfaces of the plants that they represent.

python -m benchmarks.sensing.truth_shapes

Rows of organ meshes of every cultivar, half a metre each; the truth of own rows consists of the shapes themselves.
Fruit and stems: from points on the meshes to the nearest shape of that kind. Leaves, calyces and flowers: from points
on the faces of their boxes to the meshes, by area, and from points on the meshes to the boxes (0 inside one), for boxes
as scenes have them and for coarser ones. Takes about five minutes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.common import RESULTS, parser, write_results
from benchmarks.sensing.shape_figures import box_surface
from greenhouse_gym.build.scenes import BuildSettings
from greenhouse_gym.crops import CULTIVARS, PlantRow, grow_row
from greenhouse_gym.crops.organs import THIN_KINDS, Organ
from greenhouse_gym.crops.parts import STEM_KINDS
from greenhouse_gym.crops.truth_shapes import leaf_boxes, surface_points
from greenhouse_gym.geometry import Array, Box, Shape, distance_to_shapes

SPACING = 0.002
"""Distance between points on a mesh, m."""

COARSE = 0.01
"""A coarser tolerance than that of scenes, m."""

MAX_SAMPLES = 2000
"""Maximum number of boxes, and of points on fruit and on stems, that are sampled in a row."""


def main() -> None:
    """Measure, print, write the results."""
    command = parser(__doc__)
    command.add_argument("--seed", type=int, default=541, help="of the first row")
    command.add_argument("--length", type=float, default=0.5)
    command.add_argument("--out", type=Path, default=RESULTS / "truth_shapes.json")
    arguments = command.parse_args()
    rows: dict[str, Any] = {}
    for number, style in enumerate(CULTIVARS):
        row = grow_row(arguments.seed + number, arguments.length, week=number % 3, style=style, source="helios")
        rows[style] = figures_of(row, np.random.default_rng(arguments.seed + number))
        print(style, rows[style], flush=True)
    write_results(arguments.out, {"seed": arguments.seed, "length": arguments.length, "rows": rows})


def figures_of(row: PlantRow, rng: np.random.Generator) -> dict[str, Any]:
    """Return distances in mm, and the number of boxes per metre of row."""
    stems = [organ for organ in row.organs if organ.kind in STEM_KINDS]
    fruit = [organ for organ in row.organs if organ.kind == "fruit"]
    thin = [organ for organ in row.organs if organ.kind in THIN_KINDS]
    result: dict[str, Any] = {
        "fruit": quantiles(np.abs(off(points_on(fruit), row.tomatoes, rng))),
        "stems": quantiles(np.abs(off(points_on(stems), row.stems, rng))),
    }
    leaf = points_on(thin)
    for tolerance in (BuildSettings.leaf_tolerance, COARSE):
        boxes = [box for organ in thin for box in leaf_boxes(organ.vertices, organ.triangles, tolerance)]
        drawn = [boxes[k] for k in rng.permutation(len(boxes))[:MAX_SAMPLES]]
        result[f"leaves within {1000 * tolerance:g} mm"] = {
            "boxes_per_metre": round(len(boxes) / row.length),
            "boxes_to_leaf": faces_off(drawn, leaf),
            "leaf_to_boxes": quantiles(np.maximum(off(leaf, boxes, rng), 0.0)),
        }
    return result


def points_on(organs: Sequence[Organ]) -> Array:
    """Return points (n, 3) on the meshes of organs."""
    return np.concatenate([surface_points(o.vertices, o.triangles, SPACING) for o in organs] or [np.zeros((0, 3))])


def off(points: Array, shapes: Sequence[Shape], rng: np.random.Generator) -> Array:
    """Return the signed distances (n,) of sampled points to the nearest shape."""
    return distance_to_shapes(rng.permutation(points)[:MAX_SAMPLES], shapes).min(axis=1)


def faces_off(boxes: Sequence[Box], leaf: Array) -> dict[str, float]:
    """Return quantiles, weighted by area, of the distances from boxes' faces to points on leaves."""
    tree = cKDTree(leaf)
    faces = [box_surface(box, 2 * SPACING) for box in boxes]
    return quantiles(tree.query(np.concatenate([f[0] for f in faces]))[0], np.concatenate([f[1] for f in faces]))


def quantiles(distance: Array, weight: Array | None = None) -> dict[str, float]:
    """Return the median and the 95 % quantile of distances in m, as mm."""
    order = np.argsort(distance)
    cumulated = np.cumsum(np.ones(len(order)) if weight is None else weight[order])
    at = np.searchsorted(cumulated / cumulated[-1], [0.5, 0.95])
    return dict(zip(("median_mm", "95_mm"), np.round(1000 * distance[order][at], 2).tolist(), strict=True))


if __name__ == "__main__":
    main()
