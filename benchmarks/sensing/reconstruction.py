"""Measure drift, distance to the true surfaces, and completeness of reconstructed simulated rows.

python -m benchmarks.sensing.reconstruction --lengths 2 5 --workdir recordings

Sensor noise, bias and tripod error are on. Rows of several lengths are reconstructed by the package, by plain Open3D,
and by the paper's method alone; some once more with broken stations. Every reconstruction runs
in its own process, so that the peak memory is its own, and reads its recording from disk, so that the time per station
includes reading. The seeds are used nowhere else. Each measurement is written at once; a later run measures only what
is missing or was measured by other code. Takes four hours, with ``--lengths 2 5 --methods package`` half an hour.
"""

from __future__ import annotations

import itertools
import json
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.common import (
    RESULTS,
    add_workdir,
    fingerprint,
    in_own_process,
    kept_or_temporary,
    parser,
    table,
    write_results,
)
from benchmarks.sensing import broken_stations, registration_baselines
from benchmarks.sensing.broken_stations import break_stations
from benchmarks.sensing.registration_baselines import multiway, paper_chain
from greenhouse_gym import accuracy, capture, crops, geometry, reconstruction
from greenhouse_gym.accuracy import ReconstructedRow
from greenhouse_gym.capture import Recording, Rig, open_recording, simulate_recording
from greenhouse_gym.capture.formats.own import INDEX, write_recording
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.crops import PlantRow, grow_row
from greenhouse_gym.geometry import Array, invert
from greenhouse_gym.reconstruction import reconstruct_row

METHODS: dict[str, Callable[[Recording], ReconstructedRow]] = {
    "package": reconstruct_row,
    "multiway": multiway,
    "paper_chain": paper_chain,
}
BROKEN_LENGTHS, BROKEN_METHODS = (5.0, 10.0), ("package", "paper_chain")
MISPLACED = 0.02  # m
Record = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """One measurement.

    Attributes:
        length: Length of the row, m.
        seed: Seed of the row, the walk and the noise.
        method: One of `METHODS`.
        broken: Whether 15 % of the stations are broken.
    """

    length: float
    seed: int
    method: str = "package"
    broken: bool = False

    @property
    def recording(self) -> str:
        """Name of the recording's folder."""
        return f"{self.length:g}m-{self.seed}"

    def grow(self) -> PlantRow:
        """Return the true row; its growth week follows from the seed."""
        return grow_row(self.seed, self.length, self.seed % 3)


def cases(
    lengths: Sequence[float], seeds: Sequence[int], parts: Sequence[str], methods: Sequence[str]
) -> Iterator[Case]:
    """Yield everything to measure; cases with the same recording follow each other."""
    for length, seed in itertools.product(lengths, seeds):
        if "rows" in parts:
            yield from (Case(length, seed, method) for method in methods)
        if "broken" in parts and length in BROKEN_LENGTHS:
            yield from (Case(length, seed, method, broken=True) for method in BROKEN_METHODS if method in methods)


def render(case: Case, folder: Path) -> None:
    """Write a case's recording to a folder."""
    write_recording(simulate_recording(case.grow(), case.seed), folder)


def measure(case: Case, folder: Path) -> Record:
    """Reconstruct a recording and compare it with the truth; all figures in SI units, memory in bytes."""
    open3d()  # its import is not counted
    recording, broken = break_stations(open_recording(folder), 0.15 if case.broken else 0.0, case.seed)
    started = time.perf_counter()
    row = METHODS[case.method](recording)
    seconds = time.perf_counter() - started
    memory = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    poses = np.array([station.world_from_station for station in recording])
    good = ~np.isin(np.arange(len(recording)), list(broken))
    figures = {
        "code": code(),
        **compare_with_truth(row, case.grow(), poses, recording.rig, good),
        "seconds_per_station": seconds / len(recording),
        "peak_memory": memory,
    }
    if case.broken:
        accepted = np.flatnonzero(row.registered & ~good)
        figures |= {
            "good": int(good.sum()),
            "good_registered": int((row.registered & good).sum()),
            "broken_stations": {str(i): kind for i, kind in broken.items()},
            "broken_accepted": accepted.tolist(),
            "broken_misplaced": [int(i) for i in accepted if _is_misplaced(int(i), row, poses, good)],
        }
    return asdict(case) | figures


def compare_with_truth(
    row: ReconstructedRow, truth: PlantRow, poses: Array, rig: Rig, good: npt.NDArray[np.bool_]
) -> Record:
    """Compare a reconstructed row with its truth; surfaces that only broken stations could show do not count."""
    surface = accuracy.visible_surface(truth, rig, poses[good])
    placed, aligned = accuracy.place(row, poses), accuracy.place_by_windows(row, truth, poses)
    error = accuracy.drift(row, poses)
    figures: Record = {
        "stations": len(poses),
        "registered": int(row.registered.sum()),
        "points": len(row.points),
        "walked": error.length,
        "drift": error.fraction,
    }
    for suffix, points in (("", aligned), ("_unaligned", placed)):
        distance = accuracy.distance_to_surface(points, truth)
        figures |= {
            f"distance_mean{suffix}": float(distance.mean()),
            f"distance_95{suffix}": float(np.quantile(distance, 0.95)),
            f"completeness{suffix}": accuracy.completeness(points, surface),
        }
    return figures


def _is_misplaced(i: int, row: ReconstructedRow, poses: Array, good: npt.NDArray[np.bool_]) -> bool:
    """Return whether station ``i`` is displaced relative to the nearest good station."""
    others = np.flatnonzero(row.registered & good)
    k = others[np.argmin(np.abs(others - i))]
    found = invert(row.world_from_station[k]) @ row.world_from_station[i]
    true = invert(poses[k]) @ poses[i]
    return bool(np.linalg.norm(found[:3, 3] - true[:3, 3]) > MISPLACED)


def code() -> str:
    """Return the fingerprint of the code on which the figures depend."""
    return fingerprint(geometry, crops, capture, reconstruction, accuracy, registration_baselines, broken_stations)


def main() -> None:
    """Measure what is missing, write the results, print tables."""
    command = parser(__doc__)
    command.add_argument("--lengths", type=float, nargs="+", default=[2.0, 5.0, 10.0, 20.0], help="m")
    command.add_argument("--seeds", type=int, nargs="+", default=[201, 202, 203])
    command.add_argument("--only", nargs="+", choices=["rows", "broken"], default=["rows", "broken"])
    command.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    add_workdir(command)
    command.add_argument("--out", type=Path, default=RESULTS / "reconstruction.json")
    a = command.parse_args()
    stored = json.loads(a.out.read_text())["measurements"] if a.out.exists() else []
    records = [record for record in stored if record["code"] == code()]
    todo = [
        case
        for case in dict.fromkeys(cases(a.lengths, a.seeds, a.only, a.methods))
        if not any(asdict(case).items() <= record.items() for record in records)
    ]
    for name, own in itertools.groupby(todo, key=lambda case: case.recording):
        with kept_or_temporary(a.workdir) as parent:
            for case in own:
                if not (parent / name / INDEX).exists():
                    in_own_process(render, case, parent / name)
                record = in_own_process(measure, case, parent / name)
                print(f"{name} {case.method}{' broken' * case.broken}: drift {record['drift']:.3%}", flush=True)
                records.append(record)
                write_results(a.out, {"measurements": records})
    print("\n\n".join(filter(None, tables(records))))


def tables(records: Sequence[Record]) -> Iterator[str]:
    """Yield a table of rows and methods, and one of rows with broken stations."""
    records = sorted(records, key=lambda r: (r["length"], r["seed"]))
    usual = [r for r in records if not r["broken"]]
    yield table(
        (
            "row", "method", "registered", "drift", "cloud to truth, mean / 95 %, mm", "unaligned", "complete",
            "unaligned", "s per station", "peak MiB",
        ),
        [
            (
                f"{r['length']:g} m, {r['seed']}", r["method"], f"{r['registered']} of {r['stations']}",
                f"{r['drift']:.2%}", _distances(r), _distances(r, "_unaligned"), f"{r['completeness']:.1%}",
                f"{r['completeness_unaligned']:.1%}", f"{r['seconds_per_station']:.2f}",
                f"{r['peak_memory'] / 2**20:.0f}",
            )
            for r in usual
        ],
    )  # fmt: skip
    yield table(
        ("row, broken", "method", "good registered", "broken accepted", "of these misplaced", "drift", "complete"),
        [
            (
                f"{r['length']:g} m, {r['seed']}", r["method"], f"{r['good_registered'] / r['good']:.1%}",
                f"{len(r['broken_accepted'])} of {len(r['broken_stations'])}", len(r["broken_misplaced"]),
                f"{r['drift']:.2%}", f"{r['completeness']:.1%}",
            )
            for r in records
            if r["broken"]
        ],
    )  # fmt: skip


def _distances(record: Record, suffix: str = "") -> str:
    return f"{1e3 * record[f'distance_mean{suffix}']:.2f} / {1e3 * record[f'distance_95{suffix}']:.2f}"


if __name__ == "__main__":
    main()
