"""What rows of organ meshes cost, and how they are reconstructed and searched in changing light, beside own rows.

python benchmarks/mesh_rows.py --workdir rows

All are development rows of one metre, and everything is measured in one run. Photographs: processor time of a station,
once the scene is ready. Shapes: processor time per metre, each row in a process of its own, and the tomatoes that are
found, also among leaves at a leaf area index of 3 and on an untrained vine. Light: some rows are photographed again in
each of `shape_rows.LIGHTS`; drift, distance of the cloud from the true surfaces and completeness as in
reconstruction.py, tomatoes as in shapes.py. The networks were fitted to all of these rows but the dense one, so their
tomatoes tell what light changes, and not how many are found in rows that nobody has seen.

Recordings, clouds and measurements are kept under --workdir; started again, the benchmark goes on with what is missing.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from reconstruction import apart, compared
from results_file import RESULTS, write_results
from shape_rows import LIGHTS, Row, cloud_of, recording_of
from shape_tables import pooled
from shapes import measured

OWN = tuple(Row(seed, 1.0) for seed in (301, 302, 303))
TRAINED = tuple(Row(seed, 1.0, "helios") for seed in (501, 502, 503, 504))
"""Cluster, beefsteak, cherry and plum tomatoes."""

GROUPS = {
    "own": OWN,
    "trained": TRAINED,
    "stout": (Row(505, 1.0, "helios"),),
    "bushy": (Row(506, 1.0, "helios"),),
    "dense": (Row(507, 1.0, "helios"),),
}
LIT = TRAINED[::2]
STATIONS = range(1, 4)
FIGURES = ("drift", "distance_mean", "distance_95", "completeness")


def photographed(row: Row) -> float:
    """Median processor time of a station, seconds."""
    recording = row.simulate()
    recording[0]  # which makes the scene ready
    seconds = []
    for station in STATIONS:
        started = time.process_time()
        recording[station]
        seconds.append(time.process_time() - started)
    return float(np.median(seconds))


def reconstructed(row: Row, workdir: Path) -> dict[str, float]:
    """How a row's noisy cloud compares with the true surfaces."""
    recording = recording_of(row, workdir)
    poses = np.array([station.world_from_station for station in recording])
    figures = compared(cloud_of(row, "noisy", workdir), row.grow(), poses, recording.rig, np.ones(len(poses), bool))
    return {"registered": figures["registered"] / figures["stations"], **{name: figures[name] for name in FIGURES}}


def mean_of(records: list[dict[str, float]]) -> dict[str, float]:
    """Figures of several rows in the mean."""
    return {name: float(np.mean([record[name] for record in records])) for name in records[0]}


def found(rows: tuple[Row, ...], workdir: Path) -> dict[str, Any]:
    """The tomatoes found in rows, and the processor's time per metre."""
    figures = pooled([measured(row, "noisy", workdir) for row in rows])
    parts = {name: figures["tomatoes"][name] for name in ("all", "measured")}
    return {**parts, "processor_seconds_per_metre": figures["processor_seconds_per_metre"]}


def main() -> None:
    """Measure, write the results, print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workdir", type=Path, help="where to keep everything that is made; by default none is kept")
    parser.add_argument("--out", type=Path, default=RESULTS / "mesh_rows.json")
    arguments = parser.parse_args()
    stations: dict[str, float] = {}
    shapes: dict[str, Any] = {}
    lights: dict[str, Any] = {}
    with nullcontext(arguments.workdir) if arguments.workdir else tempfile.TemporaryDirectory() as folder:
        workdir = Path(folder)
        for name, rows in GROUPS.items():
            stations[name] = float(np.mean([apart(photographed, row) for row in rows]))
            shapes[name] = found(rows, workdir)
            print(f"{name}: photographed and searched", flush=True)
        lit: dict[str, tuple[Row, ...]] = {"own rows": OWN, "drawn, all trained rows": TRAINED}
        lit |= {name: tuple(Row(row.seed, row.length, row.source, name) for row in LIT) for name in LIGHTS}
        for name, rows in lit.items():
            clouds = mean_of([apart(reconstructed, row, workdir) for row in rows])
            lights[name] = {"cloud": clouds, **found(rows, workdir)}
            print(f"{name}: reconstructed", flush=True)
    results = {"seconds_per_station": stations, "shapes": shapes, "lights": lights}
    write_results(arguments.out, results, ["open3d", "scipy", "pyhelios3d"])
    print(tables(stations, shapes, lights))


def tables(stations: dict[str, float], shapes: dict[str, Any], lights: dict[str, Any]) -> str:
    """The measurements as Markdown tables."""
    seconds = {name: group["processor_seconds_per_metre"] for name, group in shapes.items()}
    own = seconds["own"]
    lines = [
        "| rows | a station, against own | shapes per metre, s (against own) | tomatoes: F1 (of those in the cloud) |",
        "|---|---|---|---|",
    ]
    lines += [
        f"| {name} | {stations[name] / stations['own']:.2f} | {seconds[name]:.1f} ({seconds[name] / own:.2f})"
        f" | {_f1(shapes[name])} |"
        for name in shapes
    ]
    lines += [
        "",
        "| light | registered | drift | cloud to truth, mean / 95 %, mm | complete | tomatoes: F1 (in the cloud) |",
        "|---|---|---|---|---|---|",
    ]
    for name, one in lights.items():
        cloud = one["cloud"]
        lines.append(
            f"| {name} | {cloud['registered']:.0%} | {cloud['drift']:.2%} | {1e3 * cloud['distance_mean']:.2f} / "
            f"{1e3 * cloud['distance_95']:.2f} | {cloud['completeness']:.1%} | {_f1(one)} |"
        )
    return "\n".join(lines)


def _f1(group: dict[str, Any]) -> str:
    return f"{group['all']['f1']:.3f} ({group['measured']['f1']:.3f})"


if __name__ == "__main__":
    main()
