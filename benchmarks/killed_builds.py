"""A build killed outright at random moments and begun again: is the bank the one of an uninterrupted build?

python benchmarks/killed_builds.py --kills 20

Every other build has two processes, the others work in one. Moments are drawn evenly over the time that the first,
uninterrupted build takes, its start included; a build that is done before its moment counts as not killed.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from results_file import RESULTS, write_results

from greenhouse_gym.build import build_bank
from greenhouse_gym.build.scenes import BuildSettings
from greenhouse_gym.capture import open_recording, simulate_recording, write_recording
from greenhouse_gym.common.executors import executor_for
from greenhouse_gym.crops import grow_row

BACKENDS = ("serial", "processes")


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--rows", type=int, default=1)
    parser.add_argument("--length", type=float, default=0.2, help="of each row, metres")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--build", nargs=3, metavar=("RECORDINGS", "BANK", "BACKEND"), help="only build, as a child")
    a = parser.parse_args()
    if a.build:
        build(Path(a.build[0]), Path(a.build[1]), a.build[2])
        return
    moments = random.Random(a.seed)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for seed in range(970, 970 + a.rows):
            path = folder / "recordings" / f"row-{seed}"
            write_recording(simulate_recording(grow_row(seed, a.length), seed), path)
        began = time.perf_counter()
        begin(folder, "whole", "serial").wait()
        whole = time.perf_counter() - began
        expected = hashes(folder / "whole")
        kills: list[dict[str, Any]] = []
        for k in range(a.kills):
            after = moments.uniform(0.0, whole)
            child = begin(folder, f"bank-{k}", BACKENDS[k % 2])
            with suppress(subprocess.TimeoutExpired):
                child.wait(after)
            killed = child.poll() is None
            child.kill()
            child.wait()
            left = len(hashes(folder / f"bank-{k}"))
            status = begin(folder, f"bank-{k}", BACKENDS[k % 2]).wait()
            same = hashes(folder / f"bank-{k}") == expected
            kills.append(
                {"backend": BACKENDS[k % 2], "after s": round(after, 1), "killed": killed, "files left": left,
                 "resumed": status == 0, "same files": same}
            )  # fmt: skip
            print(kills[-1], flush=True)
            write(a, whole, kills)


def write(a: argparse.Namespace, whole: float, kills: list[dict[str, Any]]) -> None:
    """Write what there is so far."""
    result = {
        "uninterrupted s": round(whole, 1),
        "killed": sum(kill["killed"] for kill in kills),
        "all files equal": all(kill["same files"] for kill in kills),
        "kills": kills,
        "load at the end": round(os.getloadavg()[0], 1),
    }
    command = f"benchmarks/killed_builds.py --kills {a.kills} --rows {a.rows} --length {a.length:g} --seed {a.seed}"
    write_results(RESULTS / "killed_builds.json", {"command": command, **result}, ["mujoco", "ompl"])


def build(recordings: Path, out: Path, backend: str) -> None:
    """Build a small bank of all recordings in a folder."""
    rows = [open_recording(path) for path in sorted(recordings.iterdir())]
    with executor_for(backend, 2) as executor:
        build_bank(rows, out, "killed", settings=BuildSettings(spacing=0.2, max_targets=2), executor=executor)


def begin(folder: Path, bank: str, backend: str) -> subprocess.Popen[bytes]:
    """A process that builds, quietly."""
    command = [sys.executable, __file__, "--build", str(folder / "recordings"), str(folder / bank), backend]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder, by its path."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


if __name__ == "__main__":
    main()
