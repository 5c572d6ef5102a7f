"""How right reconstructed rows are against the truth of simulated ones: sensor noise, bias and tripod error all on.

python benchmarks/reconstruction.py --lengths 2 5 --workdir recordings

Rows of several lengths are reconstructed by the package, by plain Open3D and by the paper's chain alone; some once more
with broken stations, and some with larger camera biases. Every reconstruction runs in a process of its own, so that the
peak memory is its own, and reads its recording from disk, so that the time per station includes reading. The seeds are
used nowhere else.

Each measurement is written as soon as it is there; started again, the benchmark goes on with what is missing. What
other sources than the present ones measured does not count.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from broken_stations import break_stations
from reconstruction_tables import tables
from registration_baselines import multiway, paper_chain
from results_file import RESULTS, write_results

import greenhouse_gym
from greenhouse_gym.accuracy import (
    ReconstructedRow,
    completeness,
    distance_to_surface,
    drift,
    place,
    place_by_windows,
    visible_surface,
)
from greenhouse_gym.capture import (
    CaptureSettings,
    Recording,
    Rig,
    StereoNoise,
    open_recording,
    simulate_recording,
    write_recording,
)
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
BIAS_LENGTH, BIASES = 5.0, (0.0, 0.002, 0.005, 0.01)
MISPLACED = 0.02  # m


@dataclass(frozen=True)
class Case:
    """One thing to measure.

    Attributes:
        length: Of the row, metres.
        seed: Of the row, the walk and the noise.
        method: One of `METHODS`.
        broken: Whether 15 % of the stations are broken.
        bias: One sigma of the relative depth error of a camera.
    """

    length: float
    seed: int
    method: str = "package"
    broken: bool = False
    bias: float = StereoNoise().bias

    @property
    def week(self) -> int:
        """Growth week."""
        return self.seed % 3

    @property
    def recording(self) -> str:
        """Name of the recording's folder."""
        return f"{self.length:g}m-{self.seed}" + ("" if self.bias == StereoNoise().bias else f"-bias-{self.bias:g}")


def cases(
    lengths: Sequence[float], seeds: Sequence[int], parts: Sequence[str], methods: Sequence[str]
) -> Iterator[Case]:
    """Everything to measure; cases of one recording follow each other."""
    for length, seed in itertools.product(lengths, seeds):
        if "rows" in parts:
            yield from (Case(length, seed, method) for method in methods)
        if "broken" in parts and length in BROKEN_LENGTHS:
            yield from (Case(length, seed, method, broken=True) for method in BROKEN_METHODS if method in methods)
        if "bias" in parts and length == BIAS_LENGTH:
            yield from (Case(length, seed, bias=bias) for bias in BIASES)


def render(case: Case, folder: Path) -> None:
    """Write a case's recording to a folder."""
    settings = CaptureSettings(noise=StereoNoise(bias=case.bias))
    truth = grow_row(case.seed, case.length, case.week)
    write_recording(simulate_recording(truth, case.seed, settings=settings), folder)


def measure(case: Case, folder: Path) -> dict[str, Any]:
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
        "code": sources(),
        "week": case.week,
        **compared(row, grow_row(case.seed, case.length, case.week), poses, recording.rig, good),
        "seconds_per_station": seconds / len(recording),
        "peak_memory": memory,
    }
    if case.broken:
        accepted = row.registered & ~good
        figures |= {
            "good": int(good.sum()),
            "good_registered": int((row.registered & good).sum()),
            "broken_stations": {str(i): kind for i, kind in broken.items()},
            "broken_accepted": np.flatnonzero(accepted).tolist(),
            "broken_misplaced": [int(i) for i in np.flatnonzero(accepted) if _misplaced(int(i), row, poses, good)],
        }
    return asdict(case) | figures


def compared(
    row: ReconstructedRow, truth: PlantRow, poses: Array, rig: Rig, good: npt.NDArray[np.bool_]
) -> dict[str, Any]:
    """Figures of a reconstructed row beside its truth; nothing is asked of stations that are not ``good``."""
    surface = visible_surface(truth, rig, poses[good])
    placed, aligned = place(row, poses), place_by_windows(row, truth, poses)
    plain_distance, distance = distance_to_surface(placed, truth), distance_to_surface(aligned, truth)
    error = drift(row, poses)
    return {
        "stations": len(poses),
        "registered": int(row.registered.sum()),
        "points": len(row.points),
        "walked": error.length,
        "drift": error.fraction,
        "distance_mean": float(distance.mean()),
        "distance_95": float(np.quantile(distance, 0.95)),
        "distance_mean_unaligned": float(plain_distance.mean()),
        "distance_95_unaligned": float(np.quantile(plain_distance, 0.95)),
        "completeness": completeness(aligned, surface),
        "completeness_unaligned": completeness(placed, surface),
    }


def _misplaced(i: int, row: ReconstructedRow, poses: Array, good: npt.NDArray[np.bool_]) -> bool:
    """Whether station ``i`` stands elsewhere, seen from the nearest good one, than where its images were taken."""
    others = np.flatnonzero(row.registered & good)
    k = others[np.argmin(np.abs(others - i))]
    found = invert(row.world_from_station[k]) @ row.world_from_station[i]
    true = invert(poses[k]) @ poses[i]
    return bool(np.linalg.norm(found[:3, 3] - true[:3, 3]) > MISPLACED)


def sources() -> str:
    """A fingerprint of the sources on which the figures depend."""
    package, here = Path(greenhouse_gym.__file__).parent, Path(__file__).parent
    parts = (
        "geometry/*.py", "plants/*.py", "capture/*.py", "reconstruction/*.py",
        "accuracy/clouds.py", "accuracy/completeness.py",
    )  # fmt: skip
    files = [file for part in parts for file in sorted(package.glob(part))]
    files += [here / "registration_baselines.py", here / "broken_stations.py"]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


def apart(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a process of its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def measured(file: Path) -> list[dict[str, Any]]:
    """What an earlier run with the present sources has measured."""
    stored = json.loads(file.read_text()).get("measurements", []) if file.exists() else []
    return [record for record in stored if record["code"] == sources()]


def main() -> None:
    """Measure what is missing, write the results, print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lengths", type=float, nargs="+", default=[2.0, 5.0, 10.0, 20.0], help="metres")
    parser.add_argument("--seeds", type=int, nargs="+", default=[201, 202, 203])
    parser.add_argument("--only", nargs="+", choices=["rows", "broken", "bias"], default=["rows", "broken", "bias"])
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--workdir", type=Path, help="where to keep the rendered recordings; by default none is kept")
    parser.add_argument("--out", type=Path, default=RESULTS / "reconstruction.json")
    arguments = parser.parse_args()
    records = measured(arguments.out)
    todo = [
        case
        for case in dict.fromkeys(cases(arguments.lengths, arguments.seeds, arguments.only, arguments.methods))
        if not any(asdict(case).items() <= record.items() for record in records)
    ]
    for name, own in itertools.groupby(todo, key=lambda case: case.recording):
        with nullcontext(arguments.workdir) if arguments.workdir else tempfile.TemporaryDirectory() as parent:
            folder = Path(parent) / name
            for case in own:
                if not (folder / "recording.json").exists():
                    apart(render, case, folder)
                record = apart(measure, case, folder)
                print(f"{name} {case.method}{' broken' * case.broken}: drift {record['drift']:.3%}", flush=True)
                records.append(record)
                write_results(arguments.out, {"measurements": records}, ["open3d", "scipy"])
    print(tables(records))


if __name__ == "__main__":
    main()
