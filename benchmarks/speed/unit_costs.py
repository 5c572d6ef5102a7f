"""Measure the cost of single pieces of work, on which the estimate in docs/results/speed.md is based.

python -m benchmarks.speed.unit_costs --recordings own-cherry-2018-w09

Seconds are processor time of this process and the planning process. ``--recordings`` also builds the scenes of some
recordings of the shipped bank. Takes a minute, and another one for each recording.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.common import RESULTS, parser, processor_seconds, write_results
from greenhouse_gym.build import build_bank, shipped
from greenhouse_gym.build.grown import SETTINGS, RowRecording
from greenhouse_gym.capture import open_recording, simulate_recording, write_recording
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
    command = parser(__doc__)
    command.add_argument("--scenes", type=int, default=24)
    command.add_argument("--pieces", type=int, default=400)
    command.add_argument("--recordings", nargs="*", default=[], help="names such as own-cherry-2018-w09")
    command.add_argument("--out", type=Path, default=RESULTS / "unit_costs.json")
    a = command.parse_args()
    bank = SceneBank.open("default")
    paths = [bank.path / entry.file for entry in bank.manifest.scenes[:: len(bank) // a.scenes]]
    scenes = [Scene.load(path) for path in paths]
    worlds = Worlds(get_robot("ur5e"), "reconstruction", DEFAULT_CAPACITY)
    worlds.world(scenes[0])  # compiles what all worlds share
    witnessed = ((s, next((t for t in s.targets if t.witness is not None), None)) for s in scenes)
    reachable = [(scene, target.tomato) for scene, target in witnessed if target is not None]
    plan(*reachable[0], max_checks=10, time_limit=None)  # starts the planning process
    with tempfile.TemporaryDirectory() as folder:
        row = simulate_recording(grow_row(970, LENGTH), 970)
        simulated = spent(lambda: write_recording(row, Path(folder) / "row"))
        images = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    with processes(1) as executor:
        list(completed(abs, range(1), executor))
        pieces = spent(lambda: list(completed(abs, range(a.pieces), executor)))
    count = len(paths)
    results: dict[str, Any] = {
        "bytes of a scene": round(sum(path.stat().st_size for path in paths) / count),
        "read a scene": spent(lambda: [Scene.load(path) for path in paths]) / count,
        "read and write a scene": spent(lambda: [Scene.load(path).model_dump_json() for path in paths]) / count,
        "make a world": spent(lambda: [worlds.world(scene) for scene in scenes[1:]]) / (count - 1),
        "plan with goals": spent(partial(plan_all, reachable)) / len(reachable),
        "hand out a piece of work to a process": pieces / a.pieces,
        "simulate and write a metre": simulated / LENGTH,
        "bytes of a metre": round(images / LENGTH),
    }
    results = {name: round(value, 4) if isinstance(value, float) else value for name, value in results.items()}
    results["scenes of recordings"] = {
        row.name: built(row) for row in shipped.row_recordings() if row.name in a.recordings
    }
    print(results)
    write_results(a.out, results)


def plan_all(targets: list[tuple[Scene, int]]) -> None:
    """Plan with the usual goals for each target."""
    for scene, target in targets:
        plan(scene, target, max_checks=20_000, time_limit=None)


def spent(act: Callable[[], object]) -> float:
    """Return the processor time of a function, s."""
    before = processor_seconds()
    act()
    return processor_seconds() - before


def built(row: RowRecording) -> dict[str, Any]:
    """Build the scenes of a recording of the shipped bank, from its files."""
    with tempfile.TemporaryDirectory() as folder:
        files = Path(folder) / row.name
        write_recording(row.simulate(), files)
        before = processor_seconds()
        bank = build_bank([open_recording(files)], Path(folder) / "bank", row.name, settings=SETTINGS)
        seconds = processor_seconds() - before
        targets = [len(scene.targets) for scene in bank]
    return {"scenes": len(targets), "targets": targets, "seconds": round(seconds, 1)}


if __name__ == "__main__":
    main()
