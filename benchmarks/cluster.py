"""The same work in one process, in two processes, and on Ray, also where a node of the cluster is lost on the way.

python benchmarks/cluster.py --rows 3 --length 0.4
python benchmarks/cluster.py --rows 12 --length 0.4 --ways processes ray --rounds 2 --out cluster_walls.json

Builds a bank of simulated rows in each way and compares every file. On the way "lost", the cluster has two nodes of a
core each, both on this machine, and the second is killed when the first scene has come back. Then a planner with a
budget in checks plays the same episodes, and planners are swept over the same targets, in each of the other ways, and
the records are compared but for their times. Rounds take turns, so that whatever else the machine does falls on all.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

from killed_builds import hashes
from results_file import RESULTS, write_results

from greenhouse_gym.agents import PlannerAgent
from greenhouse_gym.build import build_bank
from greenhouse_gym.build.scenes import BuildSettings
from greenhouse_gym.capture import Recording, open_recording, simulate_recording, write_recording
from greenhouse_gym.common.executors import RayExecutor, processes
from greenhouse_gym.crops import grow_row
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.planning.planner_sweep import SweepSettings, reachable_targets, sweep_planners
from greenhouse_gym.scene import SceneBank

FIRST_SEED = 950
CHECKS = 3_000
PLANNERS = ("RRTConnect", "SBL", "LBKPIECE1")
Way = Callable[[], AbstractContextManager[Executor | None]]
WAYS: dict[str, Way] = {
    "serial": nullcontext,
    "processes": lambda: processes(2),
    "ray": lambda: RayExecutor("local", workers=2),
}
LOST = "lost"
"""Ray on two nodes, one of which is killed."""


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=3)
    parser.add_argument("--length", type=float, default=0.4, help="of each row, metres")
    parser.add_argument("--targets", type=int, default=12, help="certified in each scene")
    parser.add_argument("--ways", nargs="+", choices=[*WAYS, LOST], default=[*WAYS, LOST])
    parser.add_argument("--rounds", type=int, default=1, help="builds in each way")
    parser.add_argument("--episodes", type=int, default=60)
    parser.add_argument("--swept", type=int, default=9, help="targets of the sweep")
    parser.add_argument("--out", default="cluster.json", help="file among the results")
    a = parser.parse_args()
    began = os.getloadavg()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        recordings = [_recording(folder / "recordings", FIRST_SEED + k, a.length) for k in range(a.rows)]
        settings = BuildSettings(spacing=0.2, max_targets=a.targets)
        result = builds(recordings, folder, settings, a.ways, a.rounds)
        result |= games(folder, a.episodes, a.swept, [way for way in a.ways if way != LOST])
    command = f"benchmarks/cluster.py --rows {a.rows} --length {a.length:g} --targets {a.targets} "
    command += f"--ways {' '.join(a.ways)} --rounds {a.rounds} --episodes {a.episodes} --swept {a.swept} --out {a.out}"
    load = {"load before and after": [round(began[0], 2), round(os.getloadavg()[0], 2)]}
    write_results(RESULTS / a.out, {"command": command, **result, **load}, ["ray", "mujoco", "ompl"])
    for name, value in (result | load).items():
        print(f"{name}: {value}")


def _recording(folder: Path, seed: int, length: float) -> Recording:
    """A simulated recording, on disk as one that was taken is."""
    path = folder / f"row-{seed}"
    write_recording(simulate_recording(grow_row(seed, length), seed), path)
    return open_recording(path)


def builds(
    recordings: list[Recording], folder: Path, settings: BuildSettings, ways: list[str], rounds: int
) -> dict[str, Any]:
    """The walls of the builds, and whether they wrote the same."""
    seconds: dict[str, list[float]] = {way: [] for way in ways}
    written: list[dict[str, str]] = []
    scenes, lost = 0, False
    for turn in range(rounds):
        for way in ways if turn % 2 == 0 else reversed(ways):
            out = folder / f"{way}-{turn}"
            began = time.perf_counter()
            with _node_lost(out) if way == LOST else WAYS[way]() as executor:
                bank = build_bank(recordings, out, "rows", settings=settings, executor=executor)
            seconds[way].append(round(time.perf_counter() - began, 1))
            scenes, lost = len(bank), lost or way == LOST
            written.append(hashes(out))
            print(f"{way}: {seconds[way][-1]:.0f} s", flush=True)
    return {
        "rows": len(recordings),
        "scenes": scenes,
        "seconds of builds": seconds,
        "a node was lost": lost,
        "all wrote the same files": all(files == written[0] for files in written),
    }


@contextmanager
def _node_lost(out: Path) -> Iterator[Executor]:
    """Ray on two nodes of a core each; the second dies when there is a scene in the folder.

    Raises:
        RuntimeError: The work was done before a node could be lost.
    """
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
        _leave(cluster)
    if not killed.is_set():
        raise RuntimeError("the work was done before a node could be lost")


def _leave(cluster: Any) -> None:
    import ray

    ray.shutdown()
    cluster.shutdown()


def games(folder: Path, episodes: int, swept: int, ways: list[str]) -> dict[str, Any]:
    """Whether a planner's episodes and a sweep are the same in each way, and their walls."""
    agent = PlannerAgent("RRTConnect", time_limit=None, max_checks=CHECKS)
    targets = reachable_targets(SceneBank.open("mini"), "train", swept)
    asked = SweepSettings(seeds=2, max_checks=CHECKS)
    seconds: dict[str, dict[str, float]] = {}
    played: list[list[dict[str, Any]]] = []
    runs: list[list[dict[str, Any]]] = []
    for way in ways:
        with WAYS[way]() as executor:
            began = time.perf_counter()
            records = evaluate(agent, "train", episodes, 0, executor=executor, bank="mini").records
            between = time.perf_counter()
            runs.append(
                [_timeless(run) for run in sweep_planners(PLANNERS, targets, asked, folder / f"{way}.jsonl", executor)]
            )
            ended = time.perf_counter()
        played.append([_timeless(asdict(record)) for record in records])
        seconds[way] = {"episodes": round(between - began, 1), "sweep": round(ended - between, 1)}
        print(f"{way}: {seconds[way]}", flush=True)
    return {
        "episodes": episodes,
        "runs of the sweep": len(runs[0]) if runs else 0,
        "seconds of games": seconds,
        "same episodes": all(one == played[0] for one in played),
        "same runs": all(one == runs[0] for one in runs),
    }


def _timeless(record: dict[str, Any]) -> dict[str, Any]:
    """A record without what the machine decides."""
    timed = ("time", "seconds", "rate")
    values = {name: value for name, value in record.items() if not any(word in name for word in timed)}
    if "costs" in values:
        values["costs"] = [cost for _, cost in values["costs"]]
    return values


if __name__ == "__main__":
    main()
