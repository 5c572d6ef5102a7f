"""Measure the cost of rows of organ meshes, and their reconstruction and extraction in changing light.

python -m benchmarks.sensing.mesh_rows --workdir rows

All are development rows of one metre, next to own rows, and everything is measured in one run. Images: processor time
of a station, once the scene is ready. Shapes: processor time per metre, each row in its own process, and the tomatoes
found, also at a leaf area index of 3 and on an untrained vine. Light: some rows are photographed again in each of
`rows.LIGHTS`; drift, distance of the cloud from the true surfaces and completeness as in reconstruction.py, tomatoes as
in shapes.py. The networks were fitted to all of these rows except the dense one, so their tomatoes show the effect of
light, and not how many are found in new rows.

Recordings, clouds and measurements are kept below --workdir; a later run measures only what is missing. Takes 90
minutes.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import RESULTS, add_workdir, in_own_process, kept_or_temporary, parser, table, write_results
from benchmarks.sensing.reconstruction import compare_with_truth
from benchmarks.sensing.rows import LIGHTS, Row, cloud_of, recording_of
from benchmarks.sensing.shape_figures import pooled
from benchmarks.sensing.shapes import measured

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
    """Return the median processor time of rendering a station, s."""
    recording = row.simulate()
    recording[0]  # prepares the scene
    seconds = []
    for station in STATIONS:
        started = time.process_time()
        recording[station]
        seconds.append(time.process_time() - started)
    return float(np.median(seconds))


def reconstructed(row: Row, workdir: Path) -> dict[str, float]:
    """Compare a row's noisy cloud with the true surfaces."""
    recording = recording_of(row, workdir)
    poses = np.array([station.world_from_station for station in recording])
    figures = compare_with_truth(
        cloud_of(row, "noisy", workdir), row.grow(), poses, recording.rig, np.ones(len(poses), bool)
    )
    return {"registered": figures["registered"] / figures["stations"], **{name: figures[name] for name in FIGURES}}


def mean_of(records: list[dict[str, float]]) -> dict[str, float]:
    """Return the mean figures of several rows."""
    return {name: float(np.mean([record[name] for record in records])) for name in records[0]}


def found(rows: tuple[Row, ...], workdir: Path) -> dict[str, Any]:
    """Return the tomatoes found in rows, and the processor time per metre."""
    figures = pooled([measured(row, "noisy", workdir) for row in rows])
    parts = {name: figures["tomatoes"][name] for name in ("all", "measured")}
    return {**parts, "processor_seconds_per_metre": figures["processor_seconds_per_metre"]}


def main() -> None:
    """Measure, write the results, print tables."""
    command = parser(__doc__)
    add_workdir(command)
    command.add_argument("--out", type=Path, default=RESULTS / "mesh_rows.json")
    arguments = command.parse_args()
    stations: dict[str, float] = {}
    shapes: dict[str, Any] = {}
    lights: dict[str, Any] = {}
    with kept_or_temporary(arguments.workdir) as workdir:
        for name, rows in GROUPS.items():
            stations[name] = float(np.mean([in_own_process(photographed, row) for row in rows]))
            shapes[name] = found(rows, workdir)
            print(f"{name}: photographed and extracted", flush=True)
        lit: dict[str, tuple[Row, ...]] = {"own rows": OWN, "drawn, all trained rows": TRAINED}
        lit |= {name: tuple(Row(row.seed, row.length, row.source, name) for row in LIT) for name in LIGHTS}
        for name, rows in lit.items():
            clouds = mean_of([in_own_process(reconstructed, row, workdir) for row in rows])
            lights[name] = {"cloud": clouds, **found(rows, workdir)}
            print(f"{name}: reconstructed", flush=True)
    write_results(arguments.out, {"seconds_per_station": stations, "shapes": shapes, "lights": lights})
    heads = ("rows", "station, s", "shapes per metre, s", "tomatoes: F1 (in the cloud)")
    lines = [
        (name, f"{stations[name]:.2f}", f"{group['processor_seconds_per_metre']:.1f}", _f1(group))
        for name, group in shapes.items()
    ]
    print(table(heads, lines))
    heads = ("light", "registered", "drift", "cloud to truth, mean / 95 %, mm", "complete", heads[-1])
    lines = []
    for name, one in lights.items():
        cloud = one["cloud"]
        distances = " / ".join(f"{1e3 * cloud[key]:.2f}" for key in ("distance_mean", "distance_95"))
        cells = f"{cloud['registered']:.0%}", f"{cloud['drift']:.2%}", distances, f"{cloud['completeness']:.1%}"
        lines.append((name, *cells, _f1(one)))
    print("\n" + table(heads, lines))


def _f1(group: dict[str, Any]) -> str:
    return f"{group['all']['f1']:.3f} ({group['measured']['f1']:.3f})"


if __name__ == "__main__":
    main()
