"""Seconds that the scenes of the shipped bank take, by stage, for some of its recordings; on one core.

What is built is compared with what is shipped, byte for byte.

python benchmarks/bank_build.py own-cluster-2000-w00 helios-beefsteak-2001-w05
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from pathlib import Path

from hard_targets import seconds_of_worker
from results_file import RESULTS, write_results

from greenhouse_gym.build import shipped
from greenhouse_gym.build.scenes import cut_scenes, provenance_of
from greenhouse_gym.planning import certify_targets
from greenhouse_gym.reconstruction import reconstruct_row, settings_for
from greenhouse_gym.scene import Provenance, SceneBank
from greenhouse_gym.shapes import extract_shapes


class Clock:
    """Seconds of processor time, this process's and its planner's, and of the wall, since it was last asked."""

    def __init__(self) -> None:
        self.seconds: dict[str, dict[str, float]] = {}
        self._last = self._now()

    def _now(self) -> tuple[float, float]:
        return time.process_time() + seconds_of_worker(), time.perf_counter()

    def lap(self, stage: str) -> None:
        """Note what a stage took."""
        now = self._now()
        self.seconds[stage] = {
            "processor": round(now[0] - self._last[0], 1),
            "wall": round(now[1] - self._last[1], 1),
        }
        self._last = now


def build(row_recording: shipped.RowRecording) -> dict[str, object]:
    """Build the scenes of a recording, stage by stage."""
    clock = Clock()
    recording = row_recording.simulate()
    settings = replace(shipped.SETTINGS, reconstruction=settings_for(recording))
    clock.lap("grow")
    known = Provenance(row=row_recording.row, style=row_recording.style, source=row_recording.source)
    origin = provenance_of(recording, row_recording.week, settings, known)
    row = reconstruct_row(recording, settings.reconstruction)
    clock.lap("simulate and reconstruct")
    shapes = extract_shapes(row.points, row.colors, row.normals, settings.shapes)
    clock.lap("shapes")
    scenes = cut_scenes(row, shapes, recording, row_recording.week, settings, origin)
    clock.lap("cut, truth, seen space")
    targets = [certify_targets(scene, settings.robot, most=settings.max_targets) for scene in scenes]
    clock.lap("certify")
    made = [scene.model_copy(update={"targets": of}) for scene, of in zip(scenes, targets, strict=True)]
    shipped_ones = [scene for scene in SceneBank.open("default") if scene.name.startswith(f"{row_recording.name}-")]
    per_scene = sum(stage["processor"] for stage in clock.seconds.values()) / len(scenes)
    return {
        "stages": clock.seconds,
        "scenes": len(scenes),
        "targets": [len(of) for of in targets],
        "seconds per scene": round(per_scene, 1),
        "scenes are those of the shipped bank": [s.model_dump_json() for s in made]
        == [s.model_dump_json() for s in shipped_ones],
    }


def main() -> None:
    """Build the recordings named and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="+")
    parser.add_argument("--out", type=Path, default=RESULTS / "bank_build.json")
    arguments = parser.parse_args()
    results: dict[str, object] = {"command": f"benchmarks/bank_build.py {' '.join(arguments.recordings)}"}
    for row_recording in shipped.row_recordings():
        if row_recording.name in arguments.recordings:
            results[row_recording.name] = build(row_recording)
            print(row_recording.name, results[row_recording.name], flush=True)
            results["load at the end"] = round(os.getloadavg()[0], 1)
            write_results(arguments.out, results, ["mujoco", "ompl", "open3d"])


if __name__ == "__main__":
    main()
