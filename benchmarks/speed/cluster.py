"""Build a bank in one process, in two, and on Ray; lose a node or kill the build on the way; compare every file.

python -m benchmarks.speed.cluster --rows 3 --length 0.4
python -m benchmarks.speed.cluster --rows 12 --executors processes ray --rounds 4 --name rounds
python -m benchmarks.speed.cluster --kills 20 --rows 1 --length 0.2 --name kills

A bank of simulated rows is built by each executor, in turns, so that other work on the machine affects all alike. With
"lost", the cluster has two nodes of one core each on this machine, and the second is killed when the first scene is
written. With ``--kills``, builds in one and two processes are killed at random moments and resumed instead. Takes 10
minutes; 20 kills take 15.
"""

from __future__ import annotations

import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from benchmarks.common import RESULTS, hashes, parser, seconds_of, write_entry
from greenhouse_gym.build import build_bank
from greenhouse_gym.build.scenes import BuildSettings
from greenhouse_gym.capture import open_recording, simulate_recording, write_recording
from greenhouse_gym.common.executors import RayExecutor, executor_for, processes
from greenhouse_gym.crops import grow_row

FIRST_SEED = 950
EXECUTORS: dict[str, Callable[[], AbstractContextManager[Executor | None]]] = {
    "serial": nullcontext,
    "processes": lambda: processes(2),
    "ray": lambda: RayExecutor("local", workers=2),
}
LOST = "lost"
"""Ray on two nodes; one is killed."""


def main() -> None:
    """Measure and write the results."""
    command = parser(__doc__)
    command.add_argument("--rows", type=int, default=3)
    command.add_argument("--length", type=float, default=0.4, help="of each row, m")
    command.add_argument("--targets", type=int, default=12, help="certified in each scene")
    command.add_argument("--executors", nargs="+", choices=[*EXECUTORS, LOST], default=[*EXECUTORS, LOST])
    command.add_argument("--rounds", type=int, default=1, help="builds by each executor")
    command.add_argument("--kills", type=int, help="kill and resume so many builds instead")
    command.add_argument("--name", default="losses", help="of the entry in the file of results")
    command.add_argument("--out", type=Path, default=RESULTS / "cluster.json")
    command.add_argument("--build", nargs=3, metavar=("RECORDINGS", "BANK", "BACKEND"), help="only build, as a child")
    a = command.parse_args()
    settings = BuildSettings(spacing=0.2, max_targets=a.targets)
    if a.build:
        with executor_for(a.build[2], 2) as executor:
            build(Path(a.build[0]), Path(a.build[1]), settings, executor)
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for seed in range(FIRST_SEED, FIRST_SEED + a.rows):
            recording = simulate_recording(grow_row(seed, a.length), seed)
            write_recording(recording, folder / "recordings" / f"row-{seed}")
        if a.kills:
            results = killed_builds(folder, a.kills, a.targets)
        else:
            results = builds(folder, settings, a.executors, a.rounds)
    print(results)
    write_entry(a.out, a.name, results)


def build(recordings: Path, out: Path, settings: BuildSettings, executor: Executor | None) -> int:
    """Build a bank of all recordings in a folder; return the number of scenes."""
    rows = [open_recording(path) for path in sorted(recordings.iterdir())]
    return len(build_bank(rows, out, "rows", settings=settings, executor=executor))


def builds(folder: Path, settings: BuildSettings, executors: Sequence[str], rounds: int) -> dict[str, Any]:
    """Return the wall times of builds, and whether they wrote the same files."""
    seconds: dict[str, list[float]] = {name: [] for name in executors}
    written: list[dict[str, str]] = []
    scenes = 0
    for turn in range(rounds):
        for name in executors if turn % 2 == 0 else reversed(executors):
            out = folder / f"{name}-{turn}"
            began = time.perf_counter()
            with losing_a_node(out) if name == LOST else EXECUTORS[name]() as executor:
                scenes = build(folder / "recordings", out, settings, executor)
            seconds[name].append(round(time.perf_counter() - began, 1))
            written.append(hashes(out))
            print(f"{name}: {seconds[name][-1]:.0f} s", flush=True)
    return {
        "scenes": scenes,
        "seconds of builds": seconds,
        "a node was lost": LOST in executors,
        "all wrote the same files": all(files == written[0] for files in written),
    }


@contextmanager
def losing_a_node(out: Path) -> Iterator[Executor]:
    """Yield Ray on two nodes of a core each; the second is killed as soon as the folder holds a scene.

    Raises:
        RuntimeError: The work was done before a node could be lost.
    """
    import ray
    from ray.cluster_utils import Cluster

    # Not 127.0.0.1, which Ray takes for the machine's own address.
    head = {"num_cpus": 1, "include_dashboard": False, "node_ip_address": "127.0.0.2"}
    head["_system_config"] = {"worker_niceness": 0}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    node = cluster.add_node(num_cpus=1, node_ip_address="127.0.0.3")
    cluster.connect()
    over, killed = threading.Event(), threading.Event()

    def kill() -> None:
        while not over.wait(0.2):
            if list(out.glob("*.json")):
                cluster.remove_node(node, allow_graceful=False)
                killed.set()
                return

    watch = threading.Thread(target=kill)
    watch.start()
    try:
        with RayExecutor("auto") as executor:
            yield executor
    finally:
        over.set()
        watch.join()
        ray.shutdown()
        cluster.shutdown()
    if not killed.is_set():
        raise RuntimeError("the work was done before a node could be lost")


def killed_builds(folder: Path, kills: int, targets: int) -> dict[str, Any]:
    """Kill builds at moments drawn uniformly over the time of an uninterrupted one, and resume them."""

    def begin(bank: str, backend: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "benchmarks.speed.cluster", "--targets", str(targets), "--build"]
        command += [str(folder / "recordings"), str(folder / bank), backend]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    whole = seconds_of(lambda: begin("whole", "serial").wait())
    expected = hashes(folder / "whole")
    moments = random.Random(0)
    records: list[dict[str, Any]] = []
    for k in range(kills):
        after, backend = moments.uniform(0.0, whole), ("serial", "processes")[k % 2]
        child = begin(f"bank-{k}", backend)
        with suppress(subprocess.TimeoutExpired):
            child.wait(after)
        killed = child.poll() is None
        child.kill()
        child.wait()
        left = len(hashes(folder / f"bank-{k}"))
        resumed = begin(f"bank-{k}", backend).wait() == 0
        same = hashes(folder / f"bank-{k}") == expected
        record = {"backend": backend, "after s": round(after, 1), "killed": killed, "files left": left}
        records.append(record | {"resumed": resumed, "same files": same})
        print(records[-1], flush=True)
    return {
        "uninterrupted s": round(whole, 1),
        "killed": sum(record["killed"] for record in records),
        "all files equal": all(record["same files"] for record in records),
        "kills": records,
    }


if __name__ == "__main__":
    main()
