"""How right rows and shapes are against the truth of simulated rows, sensor noise, bias and tripod error all on.

python benchmarks/reconstruction.py --length 5 --seeds 201 202 203

Recordings are written to a temporary folder and read back, so that the time per station includes reading. The seeds are
used nowhere else.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from results_file import RESULTS, write_results

from greenhouse_gym.accuracy import distance_to_truth, drift, match_tomatoes, visible_tomatoes
from greenhouse_gym.capture import open_recording, simulate_recording, write_recording
from greenhouse_gym.geometry import invert, transform
from greenhouse_gym.plants import grow_row
from greenhouse_gym.reconstruction import reconstruct_row
from greenhouse_gym.shapes import extract_shapes


def measure(seed: int, length: float, week: int) -> dict[str, Any]:
    """Simulate, reconstruct and extract one row; all figures in SI units."""
    truth = grow_row(seed, length, week)
    with tempfile.TemporaryDirectory() as folder:
        recording = open_recording(write_recording(simulate_recording(truth, seed), Path(folder) / "recording"))
        poses = np.array([station.world_from_station for station in recording])
        started = time.perf_counter()
        row = reconstruct_row(recording)
        reconstructed = time.perf_counter()
        shapes = extract_shapes(row.points, row.colors, row.normals)
        extracted = time.perf_counter()
    first = poses[np.flatnonzero(row.registered)[0]]
    distance = distance_to_truth(row, truth, first)
    centers = transform(invert(first), np.array([tomato.center for tomato in truth.tomatoes]))
    true = [replace(tomato, center=center) for tomato, center in zip(truth.tomatoes, centers, strict=True)]
    matches = match_tomatoes(true, shapes.tomatoes)
    visible = visible_tomatoes(truth, recording.rig, poses)
    error = drift(row, poses)
    return {
        "seed": seed,
        "week": week,
        "stations": len(row.registered),
        "registered": int(row.registered.sum()),
        "length": error.length,
        "drift": error.share,
        "cloud_to_truth_mean": float(distance.mean()),
        "cloud_to_truth_95": float(np.quantile(distance, 0.95)),
        "seconds_per_station": (reconstructed - started) / len(row.registered),
        "tomatoes_visible": int(visible.sum()),
        "tomatoes_recall": float(visible[matches.true].sum() / visible.sum()),
        "tomatoes_precision": len(matches.found) / max(len(shapes.tomatoes), 1),
        "center_error_median": float(np.median(matches.center_errors)),
        "diameter_error_median": float(np.median(matches.diameter_errors)),
        "shape_seconds_per_metre": (extracted - reconstructed) / length,
    }


def main() -> None:
    """Measure some rows, print a table and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--length", type=float, default=5.0, help="metres")
    parser.add_argument("--seeds", type=int, nargs="+", default=[201, 202, 203])
    parser.add_argument("--out", type=Path, default=RESULTS / "reconstruction.json")
    arguments = parser.parse_args()
    rows = []
    print(
        "| row | registered | drift | cloud to truth, mean / 95 % | s per station | tomatoes found / right | center |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|")
    for week, seed in enumerate(arguments.seeds):
        row = measure(seed, arguments.length, week)
        rows.append(row)
        print(
            f"| {seed} | {row['registered']} of {row['stations']} | {row['drift']:.2%} "
            f"| {1e3 * row['cloud_to_truth_mean']:.1f} / {1e3 * row['cloud_to_truth_95']:.1f} mm "
            f"| {row['seconds_per_station']:.2f} | {row['tomatoes_recall']:.1%} / {row['tomatoes_precision']:.1%} "
            f"| {1e3 * row['center_error_median']:.1f} mm |",
            flush=True,
        )
    write_results(arguments.out, {"length": arguments.length, "rows": rows}, ["open3d", "scipy"])


if __name__ == "__main__":
    main()
