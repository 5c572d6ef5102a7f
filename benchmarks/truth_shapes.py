"""How far the shapes that an arm collides with in the truth lie from the surfaces of the plants they stand for.

python benchmarks/truth_shapes.py

Rows of organ meshes of every cultivar, half a metre each; the truth of the package's own rows is made of their very
shapes. Fruit and stems: from points on the meshes to the nearest shape of that kind. Leaves, calyces and flowers: from
points on the faces of their boxes to the meshes, by area, and from points on the meshes to the boxes (0 inside one),
for boxes as scenes have them and for coarser ones. Takes about five minutes.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from results_file import RESULTS, write_results
from scipy.spatial import cKDTree
from shape_boxes import box_surface

from greenhouse_gym.build.scenes import BuildSettings
from greenhouse_gym.crops import CULTIVARS, PlantRow, grow_row
from greenhouse_gym.crops.organs import THIN_KINDS, Organ
from greenhouse_gym.crops.parts import STEM_KINDS
from greenhouse_gym.crops.truth_shapes import leaf_boxes, surface_points
from greenhouse_gym.geometry import Array, Box, Shape, distance_to_shapes

SPACING = 0.002
"""Metres between the points on a mesh."""

COARSE = 0.01
"""A tolerance beside the one of scenes, metres."""

MOST = 2000
"""Boxes, and points on fruit and on stems, of a row that are looked at, drawn at random."""


def main() -> None:
    """Measure, print, write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=541, help="of the first row")
    parser.add_argument("--length", type=float, default=0.5)
    parser.add_argument("--out", type=Path, default=RESULTS / "truth_shapes.json")
    arguments = parser.parse_args()
    rows: dict[str, Any] = {}
    for number, style in enumerate(CULTIVARS):
        row = grow_row(arguments.seed + number, arguments.length, week=number % 3, style=style, source="helios")
        rows[style] = figures_of(row, np.random.default_rng(arguments.seed + number))
        print(style, rows[style], flush=True)
    write_results(arguments.out, {"seed": arguments.seed, "length": arguments.length, "rows": rows}, ["scipy"])


def figures_of(row: PlantRow, random: np.random.Generator) -> dict[str, Any]:
    """Distances in millimetres, and how many boxes stand for a metre of row."""
    stems = [organ for organ in row.organs if organ.kind in STEM_KINDS]
    fruit = [organ for organ in row.organs if organ.kind == "fruit"]
    thin = [organ for organ in row.organs if organ.kind in THIN_KINDS]
    result: dict[str, Any] = {
        "fruit": quantiles(np.abs(off(points_on(fruit), row.tomatoes, random))),
        "stems": quantiles(np.abs(off(points_on(stems), row.stems, random))),
    }
    leaf = points_on(thin)
    for tolerance in (BuildSettings.leaf_tolerance, COARSE):
        boxes = [box for organ in thin for box in leaf_boxes(organ.vertices, organ.triangles, tolerance)]
        drawn = [boxes[k] for k in random.permutation(len(boxes))[:MOST]]
        result[f"leaves within {1000 * tolerance:g} mm"] = {
            "boxes_per_metre": round(len(boxes) / row.length),
            "boxes_to_leaf": faces_off(drawn, leaf),
            "leaf_to_boxes": quantiles(np.maximum(off(leaf, boxes, random), 0.0)),
        }
    return result


def points_on(organs: Sequence[Organ]) -> Array:
    """Points (n, 3) on the meshes of organs."""
    return np.concatenate([surface_points(o.vertices, o.triangles, SPACING) for o in organs] or [np.zeros((0, 3))])


def off(points: Array, shapes: Sequence[Shape], random: np.random.Generator) -> Array:
    """Signed distances (n,) of some of the points to the nearest shape."""
    return distance_to_shapes(random.permutation(points)[:MOST], shapes).min(axis=1)


def faces_off(boxes: Sequence[Box], leaf: Array) -> dict[str, float]:
    """Quantiles, by area, of the distances of boxes' faces to points on leaves."""
    tree = cKDTree(leaf)
    faces = [box_surface(box, 2 * SPACING) for box in boxes]
    return quantiles(tree.query(np.concatenate([f[0] for f in faces]))[0], np.concatenate([f[1] for f in faces]))


def quantiles(distance: Array, weight: Array | None = None) -> dict[str, float]:
    """Median and 95 % of distances in metres, as millimetres."""
    order = np.argsort(distance)
    share = np.cumsum(np.ones(len(order)) if weight is None else weight[order])
    at = np.searchsorted(share / share[-1], [0.5, 0.95])
    return dict(zip(("median_mm", "95_mm"), np.round(1000 * distance[order][at], 2).tolist(), strict=True))


if __name__ == "__main__":
    main()
