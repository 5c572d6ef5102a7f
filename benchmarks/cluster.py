"""The same work in one process, in two processes, and on a Ray cluster of two nodes of which one is lost on the way.

python benchmarks/cluster.py --rows 3 --length 0.4

Builds a bank of simulated rows three times and compares every file; the second node of the cluster is killed when the
first scene has come back from it or from the other. Then a planner with a budget in checks plays the same episodes by
each of the three, and the records are compared but for their times. Both nodes are on this machine, a core each, so
walls are compared, not added up.
"""

from __future__ import annotations

import argparse
import hashlib
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

from results_file import RESULTS, write_results

from greenhouse_gym.agents import PlannerAgent
from greenhouse_gym.build import build_bank
from greenhouse_gym.capture import Recording, simulate_recording, write_recording
from greenhouse_gym.capture.recordings import open_recording
from greenhouse_gym.cutting import BuildSettings
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.parallel import RayExecutor, processes
from greenhouse_gym.plants import grow_row

FIRST_SEED = 950
CHECKS = 3_000


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=3)
    parser.add_argument("--length", type=float, default=0.4, help="of each row, metres")
    parser.add_argument("--targets", type=int, default=12, help="certified in each scene")
    parser.add_argument("--episodes", type=int, default=60)
    parser.add_argument("--out", type=Path, default=RESULTS / "cluster.json")
    a = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        recordings = [_recording(folder / "recordings", FIRST_SEED + k, a.length) for k in range(a.rows)]
        settings = BuildSettings(spacing=0.2, targets=a.targets)
        result = builds(recordings, folder, settings) | games(a.episodes)
    command = f"benchmarks/cluster.py --rows {a.rows} --length {a.length:g} --targets {a.targets} "
    write_results(a.out, {"command": f"{command}--episodes {a.episodes}", **result}, ["ray", "mujoco", "ompl"])
    for name, value in result.items():
        print(f"{name}: {value}")


def _recording(folder: Path, seed: int, length: float) -> Recording:
    """A simulated recording, on disk as one that was taken is."""
    path = folder / f"row-{seed}"
    write_recording(simulate_recording(grow_row(seed, length), seed), path)
    return open_recording(path)


def builds(recordings: list[Recording], folder: Path, settings: BuildSettings) -> dict[str, Any]:
    """The walls of the three builds, and whether they wrote the same."""
    ways: dict[str, Callable[[], AbstractContextManager[Executor | None]]] = {
        "serial": nullcontext,
        "processes": lambda: processes(2),
        "ray": lambda: RayExecutor("auto"),
    }
    seconds: dict[str, float] = {}
    files: dict[str, dict[str, str]] = {}
    lost = False
    for way, executor in ways.items():
        cluster = _two_nodes() if way == "ray" else None
        nodes = list(cluster.worker_nodes) if cluster else []

        def watch(stage: str, cluster: Any = cluster, nodes: list[Any] = nodes) -> None:
            nonlocal lost
            print(f"{stage}", flush=True)
            if nodes and "certifying" in stage:
                cluster.remove_node(nodes.pop(), allow_graceful=False)
                lost = True

        began = time.perf_counter()
        with executor() as pool:
            build_bank(recordings, folder / way, "rows", settings=settings, on_stage=watch, executor=pool)
        seconds[way] = time.perf_counter() - began
        files[way] = _hashes(folder / way)
        if cluster:
            cluster.shutdown()
    return {
        "rows": len(recordings),
        "files": len(files["serial"]),
        "seconds": seconds,
        "processes_faster_by": seconds["serial"] / seconds["processes"],
        "a_node_was_lost": lost,
        "processes_wrote_the_same": files["processes"] == files["serial"],
        "ray_wrote_the_same": files["ray"] == files["serial"],
    }


def games(episodes: int) -> dict[str, Any]:
    """Whether a planner's episodes are the same by each of the three ways, and their walls."""
    agent = PlannerAgent("RRTConnect", time_limit=None, max_checks=CHECKS)
    seconds: dict[str, float] = {}
    records: dict[str, list[dict[str, Any]]] = {}
    ways = {"serial": nullcontext, "processes": lambda: processes(2), "ray": lambda: RayExecutor("local", workers=2)}
    for way, executor in ways.items():
        with executor() as pool:
            began = time.perf_counter()
            played = evaluate(agent, "train", episodes, 0, progress=False, executor=pool, bank="mini")
            seconds[way] = time.perf_counter() - began
        records[way] = [_timeless(asdict(record)) for record in played.records]
    return {
        "episodes": episodes,
        "seconds_of_episodes": seconds,
        "same_records": records["serial"] == records["processes"] == records["ray"],
    }


def _timeless(record: dict[str, Any]) -> dict[str, Any]:
    """A record without what the machine decides."""
    return {name: value for name, value in record.items() if "time" not in name and "seconds" not in name}


def _two_nodes() -> Any:
    """A Ray cluster of two nodes of a core each, which this process has joined."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    cluster.add_node(num_cpus=1)
    cluster.connect()
    return cluster


def _hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a bank, by its path."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


if __name__ == "__main__":
    main()
