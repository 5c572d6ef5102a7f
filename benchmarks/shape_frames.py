"""How much hangs on where the voxel grids fall: tomatoes found in the same clouds, moved, by one grid and by several.

python benchmarks/shape_frames.py --workdir rows [--source helios --seeds 601 602 ...]

The rows are those of shapes.py; by default the ten held-out rows of Helios' plants, of one metre. Their noisy clouds
are placed as the truth is, and then shifted by up to 3 cm along each axis, frame by frame: nothing but the voxels
changes. For each number of grids, the figures are given frame by frame and in the mean. Nothing is chosen by them.
"""

from __future__ import annotations

import argparse
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from results_file import RESULTS, write_results
from shape_rows import HELD_OUT_MESHES, Row, cloud_of, truth_of, visible_of

from greenhouse_gym.accuracy import TomatoComparison, compare_tomatoes, pool_tomatoes
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction.point_clouds import Cloud
from greenhouse_gym.shapes import ShapeSettings
from greenhouse_gym.shapes.checks import Notes, thinned
from greenhouse_gym.shapes.grids import by_grids
from greenhouse_gym.shapes.surfaces import look_at_surfaces
from greenhouse_gym.shapes.tomatoes import find_tomatoes

_FARTHEST = 0.03  # metres


def frames(count: int) -> list[Array]:
    """Poses (4, 4) of the world in so many frames; the first is its own."""
    poses = [np.eye(4) for _ in range(count)]
    for k, pose in enumerate(poses[1:], start=1):
        pose[:3, 3] = np.random.default_rng(k).uniform(0.0, _FARTHEST, 3)
    return poses


def compared(row: Row, workdir: Path, frame_from_world: Array, settings: ShapeSettings) -> TomatoComparison:
    """The tomatoes that are found in a row's cloud in a frame; pipes stay in it."""
    cloud = cloud_of(row, "noisy", workdir)
    known = truth_of(row, cloud, workdir)
    whole = Cloud(cloud.points, cloud.colors, cloud.normals).transformed(frame_from_world @ known.world_from_row)
    surface = look_at_surfaces(thinned(whole, True, settings, Notes()), settings)
    found, _ = find_tomatoes(list(by_grids(whole, surface, settings)), settings)
    placed = [tomato.transformed(np.linalg.inv(frame_from_world)) for tomato in found]
    return compare_tomatoes(known.row.tomatoes, visible_of(row, workdir).tomatoes, placed)


def figures(comparison: TomatoComparison) -> dict[str, Any]:
    """What is compared, of all rows in one frame."""
    return {
        "visible": len(comparison.found),
        "found": int(comparison.found.sum()),
        "false": len(comparison.false),
        "f1": comparison.f1,
        "green f1": comparison.of_ripeness(0.0, 1 / 3).f1,
        "trusses": len(comparison.truss_right),
        "trusses right": int(comparison.truss_right.sum()),
    }


def main() -> None:
    """Measure, write the results, print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workdir", type=Path, required=True, help="where shapes.py keeps recordings and clouds")
    parser.add_argument("--source", choices=("own", "helios"), default="helios")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(HELD_OUT_MESHES))
    parser.add_argument("--length", type=float, default=1.0)
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--grids", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--out", type=Path, default=RESULTS / "shape_frames.json")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    results: dict[str, list[dict[str, Any]]] = {}
    for grids in arguments.grids:
        settings = replace(ShapeSettings(), grids=grids)
        each = []
        for pose in frames(arguments.frames):
            rows = [Row(seed, arguments.length, arguments.source) for seed in arguments.seeds]
            each.append(figures(pool_tomatoes([compared(row, arguments.workdir, pose, settings) for row in rows])))
            print(f"{grids} grids, frame {len(each)}: {each[-1]}", flush=True)
        results[str(grids)] = each
    means = {k: {name: float(np.mean([f[name] for f in each])) for name in each[0]} for k, each in results.items()}
    write_results(
        arguments.out,
        {"source": arguments.source, "seeds": arguments.seeds, "by grids": results, "means": means},
        ["scipy"],
    )
    for k, mean in means.items():
        print(f"{k} grids, mean of {arguments.frames} frames: " + ", ".join(f"{n} {v:.4g}" for n, v in mean.items()))


if __name__ == "__main__":
    main()
