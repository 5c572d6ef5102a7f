"""What single pieces of work cost, on which the estimate of docs/cluster.md stands; in seconds of processor time.

python benchmarks/unit_costs.py
"""

from __future__ import annotations

import argparse
import hashlib
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hard_targets import seconds_of_worker
from results_file import RESULTS, write_results

from greenhouse_gym.capture import simulate_recording, write_recording
from greenhouse_gym.common.executors import completed, processes
from greenhouse_gym.crops import grow_row
from greenhouse_gym.envs.worlds import Worlds
from greenhouse_gym.planning import plan
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.mjcf import DEFAULT_CAPACITY

LENGTH = 0.4  # m of the recording that is written


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=24)
    parser.add_argument("--pieces", type=int, default=400)
    a = parser.parse_args()
    bank = SceneBank.open("default")
    paths = [bank.path / entry.file for entry in bank.manifest.scenes[:: len(bank) // a.scenes]]
    scenes = [Scene.load(path) for path in paths]
    worlds = Worlds(get_robot("ur5e"), "reconstruction", DEFAULT_CAPACITY)
    worlds.world(scenes[0])  # what is made once
    reachable = [(s, next(t for t in s.targets if t.witness is not None)) for s in scenes if _reaches(s)]
    plan(reachable[0][0], reachable[0][1].tomato, max_checks=10, time_limit=None)  # starts the planning process
    with tempfile.TemporaryDirectory() as folder:
        row = simulate_recording(grow_row(970, LENGTH), 970)
        simulated = spent(lambda: write_recording(row, Path(folder) / "row"))
        images = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    with processes(1) as executor:
        list(completed(abs, range(1), executor))
        pieces = spent(lambda: list(completed(abs, range(a.pieces), executor)))
    count = len(paths)
    result: dict[str, Any] = {
        "command": f"benchmarks/unit_costs.py --scenes {a.scenes} --pieces {a.pieces}",
        "bytes of a scene": round(sum(path.stat().st_size for path in paths) / count),
        "read a scene": spent(lambda: [Scene.load(path) for path in paths]) / count,
        "read, write and check a scene": spent(lambda: [_written(path) for path in paths]) / count,
        "make a world": spent(lambda: [worlds.world(scene) for scene in scenes[1:]]) / (count - 1),
        "plan with goals": spent(
            lambda: [plan(s, t.tomato, max_checks=20_000, time_limit=None) for s, t in reachable]
        ) / len(reachable),
        "hand out a piece of work to a process": pieces / a.pieces,
        "simulate and write a metre": simulated / LENGTH,
        "bytes of a metre": round(images / LENGTH),
        "load at the end": round(os.getloadavg()[0], 1),
    }  # fmt: skip
    result = {name: round(value, 4) if isinstance(value, float) else value for name, value in result.items()}
    print(result)
    write_results(RESULTS / "unit_costs.json", result, ["mujoco", "ompl"])


def _reaches(scene: Scene) -> bool:
    return any(target.witness is not None for target in scene.targets)


def _written(path: Path) -> str:
    content = Scene.load(path).model_dump_json() + "\n"
    path.read_bytes()
    return hashlib.sha256(content.encode()).hexdigest()


def spent(act: Callable[[], object]) -> float:
    """Processor time of this process and of the planner's while something is done."""
    before = time.process_time() + seconds_of_worker()
    act()
    return time.process_time() + seconds_of_worker() - before


if __name__ == "__main__":
    main()
