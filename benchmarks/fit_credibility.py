"""Fit the weights by which shape extraction tells fruit from leaves, and print them for `shapes/credibility.py`.

python benchmarks/fit_credibility.py --workdir rows --own 302 --helios 501 502 503 504 505 506

Candidates of both looks at development rows of both generators are labeled by the truth: a sphere is right if its
center lies within half a radius of a fruit's and its size within a third; what is nearly so counts for neither side.
With only one of the generators given, its weights can be reported on the other: the area under the curve (AUC) of each
row is printed for weights of all, of own and of Helios rows.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from shape_rows import Row, cloud_of, truth_of

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction.point_clouds import Cloud
from greenhouse_gym.shapes import ShapeSettings
from greenhouse_gym.shapes.candidates import MEASURES
from greenhouse_gym.shapes.checks import Notes, thinned
from greenhouse_gym.shapes.credibility import IN_ROW, credibility
from greenhouse_gym.shapes.grids import Grid, by_grids
from greenhouse_gym.shapes.spheres import SphereFit
from greenhouse_gym.shapes.surfaces import SurfaceCloud, look_at_surfaces
from greenhouse_gym.shapes.tomatoes import look

_RIDGE = 2.0


class Labeled(NamedTuple):
    """Measures (k, m) of candidates and which of them (k,) are fruit."""

    measures: Array
    right: npt.NDArray[np.bool_]


def labeled(fits: Sequence[SphereFit], measures: Array, true: Sequence[Tomato]) -> Labeled:
    """Candidates with their labels, without those that are nearly right."""
    centers, radii = np.array([t.center for t in true]), np.array([t.radius for t in true])
    away = np.linalg.norm(np.array([f.center for f in fits]).reshape(-1, 1, 3) - centers, axis=-1) / radii
    nearest = away.argmin(axis=1)
    away = away[np.arange(len(fits)), nearest]
    sized = np.abs(np.log(np.array([f.radius for f in fits]) / radii[nearest])) < 0.35
    clear = ~(sized & (away >= 0.5) & (away < 1.0))
    return Labeled(measures[clear], (sized & (away < 0.5))[clear])


def grids_of(row: Row, workdir: Path, cause: str = "noisy") -> tuple[Iterator[Grid], Sequence[Tomato]]:
    """A row's cloud of one of the `CAUSES` in the frame of the truth, grid by grid, and its true tomatoes."""
    cloud, settings = cloud_of(row, cause, workdir), ShapeSettings()
    known = truth_of(row, cloud, workdir)
    whole = Cloud(cloud.points, cloud.colors, cloud.normals).transformed(known.world_from_row)
    surface = look_at_surfaces(thinned(whole, True, settings, Notes()), settings)
    return by_grids(whole, surface, settings), known.row.tomatoes


def surfaces_of(row: Row, workdir: Path, cause: str = "noisy") -> tuple[SurfaceCloud, SurfaceCloud, Sequence[Tomato]]:
    """The same by the first grid, thinned and fine."""
    grids, true = grids_of(row, workdir, cause)
    first = next(grids)
    return first.surface, first.fine, true


def looks_at(row: Row, workdir: Path) -> tuple[Labeled, Labeled]:
    """The candidates of the first and of the second look at a row."""
    surface, _, true = surfaces_of(row, workdir)
    looks = look(surface, ShapeSettings())
    count = len(IN_ROW) - 1  # the regressions are not told of the surroundings
    return labeled(looks.fits, looks.first[:, :count], true), labeled(looks.beside, looks.second[:, :count], true)


def fitted(parts: Sequence[Labeled], columns: int | None = None) -> Array:
    """Weights and offset by ridge logistic regression (Newton's method) on standardized measures."""
    measures = np.concatenate([part.measures for part in parts])[:, :columns]
    right = np.concatenate([part.right for part in parts])
    mean, deviation = measures.mean(axis=0), measures.std(axis=0) + 1e-9
    design = np.column_stack([(measures - mean) / deviation, np.ones(len(measures))])
    ridge = _RIDGE * np.eye(design.shape[1])
    ridge[-1, -1] = 1e-6
    weights = np.zeros(design.shape[1])
    for _ in range(50):
        likely = credibility(design[:, :-1], weights)
        curved = np.maximum(likely * (1 - likely), 1e-6)
        step = np.linalg.solve(
            design.T @ (curved[:, None] * design) + ridge, design.T @ (right - likely) - ridge @ weights
        )
        weights = weights + step
        if np.abs(step).max() < 1e-7:
            break
    scaled = weights[:-1] / deviation
    return np.append(scaled, weights[-1] - scaled @ mean)


def area(part: Labeled, weights: Array) -> float:
    """Area under the curve of true against false positives."""
    rank = credibility(part.measures, weights).argsort().argsort()
    count = int(part.right.sum())
    return float((rank[part.right].mean() - (count - 1) / 2) / max(len(part.right) - count, 1))


def main() -> None:
    """Fit, print the weights and how they fare across generators."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workdir", type=Path, required=True)
    parser.add_argument("--own", type=int, nargs="*", default=[302])
    parser.add_argument("--helios", type=int, nargs="*", default=[501, 502, 503, 504, 505, 506])
    parser.add_argument("--length", type=float, default=1.0)
    arguments = parser.parse_args()
    rows = {"own": arguments.own, "helios": arguments.helios}
    found: dict[Row, Any] = {}
    for source, seeds in rows.items():
        for seed in seeds:
            row = Row(seed, arguments.length, source)
            found[row] = looks_at(row, arguments.workdir)
    first, second = [f for f, _ in found.values()], [s for _, s in found.values()]
    np.set_printoptions(precision=4, suppress=True, linewidth=110)
    print("ALONE", fitted(first, len(MEASURES)), "IN_ROW", fitted(first), "BESIDE", fitted(second), sep="\n")
    for name in ("all", *(source for source, seeds in rows.items() if seeds)):
        weights = fitted([f for row, (f, _) in found.items() if name in ("all", row.source)])
        print(name, {row.name: round(area(f, weights), 4) for row, (f, _) in found.items()})


if __name__ == "__main__":
    main()
