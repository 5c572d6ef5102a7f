"""Measure the shapes extracted from real clouds: an apple tree, cans and mugs on a table, scanned tomato seedlings.

python -m benchmarks.sensing.real_data [--only orchard] [--pictures FOLDER]

No setting is changed for them. The apple tree is measured with the normals of its depth image and without them; a label
is hit if the center of a sphere lies in its box, and of those hit a size is right within 20 % of the caliper. With
--pictures both are drawn side by side. Tables keep their size; seedlings, some centimetres high, are scaled to the
height of a piece of a grown plant, and their figures are metres at that height. A seedling's main stem is its skeleton
from the lowest node to the first fork, or the line through the points with that label. The data come from others and
are not part of the repository: without the folder GREENHOUSE_GYM_REAL_DATA nothing is measured. --only replaces the
results of some sets and keeps those of the others. Takes 4 minutes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from benchmarks.common import REAL_DATA, RESULTS, parser, write_entry
from benchmarks.sensing.orchard import draw_orchard, measure_orchard, read_orchard
from benchmarks.sensing.real_clouds import (
    CYLINDERS,
    JUNCTION,
    MAIN,
    STALK,
    Seedling,
    TableScene,
    read_seedlings,
    read_table,
)
from greenhouse_gym.accuracy import StemComparison, compare_stems, pool_stems
from greenhouse_gym.accuracy.cover import COVERED_WITHIN
from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.geometry import Array, Capsule, distance_to_nearest, frame_along
from greenhouse_gym.shapes import extract_shapes

SEEDLING_HEIGHT = 0.4
"""Height to which every seedling is scaled, m."""

Figures = dict[str, Any]


def measure_table(scene: TableScene) -> tuple[dict[str, Figures], Figures]:
    """Compare each can and mug with its labeled points, and count the other shapes on the table."""
    shapes = extract_shapes(scene.points, scene.colors, scene.normals)
    cans = {
        f"{scene.name} {label}": measure_can(scene.points[scene.labels == label], shapes.stems)
        for label in CYLINDERS[scene.name]
    }
    pipes = sum(stem.kind == "pipe" for stem in shapes.stems)
    found = sum(can["found"] for can in cans.values())
    return cans, {
        "other_pipes": pipes - found,
        "other_stems": len(shapes.stems) - pipes,
        "tomatoes": len(shapes.tomatoes),  # the table has none
    }


def measure_can(points: Array, stems: Sequence[Stem]) -> Figures:
    """Compare a labeled can's points (n, 3) with the stem that explains most of them."""
    reference = fit_cylinder(points)
    explained = [np.abs(distance_to_nearest(points, [stem], 0.01)) < 0.01 for stem in stems]
    best = max(range(len(stems)), key=lambda i: int(explained[i].sum()), default=-1)
    own = residual(points, reference)
    figures: Figures = {"points": len(points), "reference_radius": reference.radius, "reference_residual": own}
    if best < 0 or explained[best].mean() < 0.3:
        return figures | {"found": False}
    stem = stems[best]
    cosine = abs(direction(stem) @ direction(reference))
    return figures | {
        "found": True,
        "radius": stem.radius,
        "radius_residual": residual(points, stem),
        "axis_angle": float(np.arccos(min(cosine, 1.0))),
    }


def residual(points: Array, cylinder: Capsule) -> float:
    """Return the median distance of points (n, 3) from the cylinder's side, m."""
    along = direction(cylinder)
    away = points - cylinder.start
    return float(np.median(np.abs(np.linalg.norm(away - np.outer(away @ along, along), axis=1) - cylinder.radius)))


def direction(capsule: Capsule) -> Array:
    """Return the unit vector along a capsule."""
    return np.asarray((capsule.end - capsule.start) / capsule.length)


def fit_cylinder(points: Array) -> Capsule:
    """Fit a cylinder to labeled points (n, 3) by robust least squares of the distance to the axis minus the radius.

    The fit starts from several directions, since the points show one side of the cylinder and perhaps an end.
    """
    thinned = points[:: max(1, len(points) // 1500)]
    center = thinned.mean(axis=0)
    fits = []
    for along in (*np.eye(3), *np.linalg.svd(thinned - center, full_matrices=False)[2]):
        frame = frame_along(along)

        def away(x: Array, frame: Array = frame) -> Array:
            axis = frame @ [x[2], x[3], 1.0]
            apart = thinned - center - frame[:, :2] @ x[:2]
            return np.asarray(np.linalg.norm(np.cross(apart, axis / np.linalg.norm(axis)), axis=1) - x[4])

        fit = least_squares(away, [*(frame[:, :2].T @ [0.0, 0.0, 0.03]), 0.0, 0.0, 0.035], loss="cauchy", f_scale=0.001)
        fits.append((fit.cost, frame, fit.x))
    _, frame, x = min((f for f in fits if 0.01 < f[2][4] < 0.15), key=lambda f: f[0])
    axis = frame @ [x[2], x[3], 1.0]
    axis /= np.linalg.norm(axis)
    origin = center + frame[:, :2] @ x[:2]
    reach = (points - origin) @ axis
    return Capsule(origin + reach.min() * axis, origin + reach.max() * axis, float(x[4]))


def measure_seedling(plant: Seedling) -> tuple[StemComparison, Figures]:
    """Compare a seedling's main stem with the extracted stems, and measure false stems; lengths after scaling."""
    shapes = extract_shapes(plant.points, plant.colors)
    found = [replace(stem, kind="main") for stem in shapes.stems]
    edges = chain(slice_means(plant.points[plant.labels == MAIN])) if plant.skeleton is None else plant.skeleton
    true = [Stem(a, b, 0.002, "main") for a, b in edges if np.linalg.norm(b - a) > 1e-6]
    main = true if plant.skeleton is None else [Stem(a, b, 0.002, "main") for a, b in to_first_fork(plant.skeleton)]
    compared = compare_stems(true, main, [], found, "main")
    figures: Figures = {
        "points": len(plant.points),
        "scale": plant.scale,
        "main_stem": compared.visible,
        "recall": compared.recall,
        "axis_error": float(np.median(compared.axis_error)),
        "stems": len(shapes.stems),
        "tomatoes": len(shapes.tomatoes),  # seedlings have none
    }
    if plant.labels is None:
        figures |= {"whole_skeleton_recall": compare_stems(true, true, [], found, "main").recall}
        figures |= {"false": compared.false_fraction}
    else:
        stem = plant.points[plant.labels == MAIN]
        near = np.abs(distance_to_nearest(stem, found, COVERED_WITHIN))
        stalk = distance_to_nearest(plant.points[plant.labels == STALK], found, COVERED_WITHIN)
        figures |= {"radius_residual": float(np.median(near[near <= COVERED_WITHIN]))}
        figures |= {"stalk_points_covered": float((stalk <= COVERED_WITHIN).mean())}
        figures |= {"false": false_length(found, plant.points[np.isin(plant.labels, (JUNCTION, MAIN, STALK))])}
    return compared, figures


def slice_means(points: Array, height: float = 0.01) -> Array:
    """Return the means (k, 3) of the points (n, 3) in horizontal slices, from the lowest up."""
    slices = np.floor(points[:, 2] / height)
    return np.array([points[slices == number].mean(axis=0) for number in np.unique(slices)])


def chain(nodes: Array) -> Array:
    """Return the edges (k - 1, 2, 3) from each of the nodes (k, 3) to the next."""
    return np.stack([nodes[:-1], nodes[1:]], axis=1)


def to_first_fork(edges: Array) -> Array:
    """Return the edges (m, 2, 3) of a tree (k, 2, 3) from the lowest node to the first fork."""
    nodes, ends = np.unique(edges.reshape(-1, 3), axis=0, return_inverse=True)
    left = ends.reshape(-1, 2).tolist()
    degrees = np.bincount(ends.ravel())
    path = [int(np.argmin(nodes[:, 2]))]
    while len(path) == 1 or degrees[path[-1]] == 2:
        edge = next(edge for edge in left if path[-1] in edge)
        left.remove(edge)
        path.append(edge[0] + edge[1] - path[-1])
    return chain(nodes[path])


def false_length(stems: Sequence[Stem], points: Array) -> float:
    """Return the fraction of the stems' length farther than `COVERED_WITHIN` from labeled points (n, 3)."""
    if not stems:
        return float("nan")
    tree = cKDTree(points)
    far = total = 0.0
    for stem in stems:
        along = (np.arange(8) + 0.5)[:, None] / 8
        gap = tree.query(stem.start + along * (stem.end - stem.start))[0] - stem.radius
        far, total = far + stem.length * float((gap > COVERED_WITHIN).mean()), total + stem.length
    return far / total


def orchard(pictures: Path | None) -> Figures:
    """Measure the apple tree with and without normals."""
    frame = read_orchard(REAL_DATA)
    cloud = frame.cloud
    runs = {
        "with normals": extract_shapes(cloud.points, cloud.colors, cloud.normals),
        "without normals": extract_shapes(cloud.points, cloud.colors),
    }
    if pictures:
        pictures.mkdir(parents=True, exist_ok=True)
        draw_orchard(frame, list(runs.values()), pictures / "orchard.jpg")
    return {name: measure_orchard(frame, shapes) for name, shapes in runs.items()}


def tables() -> Figures:
    """Measure the cans and mugs, and the false shapes on their tables."""
    cans: dict[str, Figures] = {}
    others: dict[str, Figures] = {}
    for name in CYLINDERS:
        on_table, others[name] = measure_table(read_table(REAL_DATA, name))
        cans |= on_table
    found = [can for can in cans.values() if can["found"]]
    summary = {
        "cans_found": len(found),
        "cans": len(cans),
        "radius_residual_median": float(np.median([can["radius_residual"] for can in found])),
        "axis_angle_median": float(np.median([can["axis_angle"] for can in found])),
        "tomatoes": sum(table["tomatoes"] for table in others.values()),
    }
    return {"all": summary, **cans, **others}


def seedlings() -> Figures:
    """Measure the seedlings' main stems."""
    compared: list[StemComparison] = []
    plants: dict[str, Figures] = {}
    for plant in read_seedlings(REAL_DATA, SEEDLING_HEIGHT):
        comparison, plants[plant.name] = measure_seedling(plant)
        compared.append(comparison)
    stems = pool_stems(compared)
    summary = {
        "recall": stems.recall,
        "axis_error_median": float(np.median(stems.axis_error)),
        "tomatoes": sum(plant["tomatoes"] for plant in plants.values()),
    }
    return {"all": summary, **plants}


def main() -> None:
    """Measure, write the results, print them."""
    command = parser(__doc__)
    command.add_argument("--only", nargs="+", choices=("orchard", "tables", "seedlings"), help="by default all")
    command.add_argument("--pictures", type=Path, help="folder for pictures")
    command.add_argument("--out", type=Path, default=RESULTS / "real_data.json")
    a = command.parse_args()
    if not REAL_DATA.is_dir():
        print("skipped: GREENHOUSE_GYM_REAL_DATA names no folder")
        return
    sets = {"orchard": lambda: orchard(a.pictures), "tables": tables, "seedlings": seedlings}
    for name in a.only or sets:
        figures = sets[name]()
        write_entry(a.out, name, figures)
        for part, values in figures.items():
            print(
                name, part, {key: round(v, 4) if isinstance(v, float) else v for key, v in values.items()}, flush=True
            )


if __name__ == "__main__":
    main()
