"""How well the places of a rig's cameras, and their depth errors, are found: from boards, and from plants alone.

A drawn ChArUco board is seen eight times by three cameras with blur, noise and depth errors of 1 % and -0.6 %; without
a board, eight stations of a simulated row are seen with the usual noise. The rig file that is given has the last camera
turned by 0 or 3 degrees and shifted by 0 or 10 mm, the others where they are. Told is the largest error of a camera's
place, and by how much the last camera is said to have moved: more than 2 degrees or 20 mm is said to be a knock. Two
minutes.

    python benchmarks/calibration.py
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from results_file import RESULTS, write_results

from greenhouse_gym.capture import SEED_RIG, Camera, Recording, Rig, Station, simulate_recording
from greenhouse_gym.capture.boards import calibrate_from_boards
from greenhouse_gym.capture.rig_file import Mounting
from greenhouse_gym.crops import grow_row
from greenhouse_gym.geometry import invert, pose, rotation_about, rotation_angle
from greenhouse_gym.reconstruction.rig_from_overlap import calibrate_from_overlap

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "capture"))  # the boards are those of the tests
from test_boards import BIAS, BOARD, shown, true_rig

BOARD_SEEDS, ROW_SEEDS = range(5), range(3)
STATIONS = 8
KNOCKS = ((0.0, 0.0), (3.0, 0.01))  # degrees, metres
AXIS = np.array([0.3, 1.0, 0.2])


def main() -> None:
    """Print a table and write it to ``benchmarks/results/calibration.json``."""
    rows = []
    for knock in KNOCKS:
        for seed in BOARD_SEEDS:
            found = calibrate_from_boards(shown(seed), knocked(true_rig(), *knock), BOARD)
            depth = max(abs(found.mounting.depth_error.get(name, 0.0) - bias) for name, bias in BIAS.items())
            row = errors(true_rig(), found.mounting, found.turned["last"], found.shifted["last"])
            rows.append({"from": "boards", "seed": seed, "knock": knock, **row, "depth": depth})
        for seed in ROW_SEEDS:
            walk = in_memory(simulate_recording(grow_row(seed, 0.8), seed, SEED_RIG, STATIONS))
            found_without = calibrate_from_overlap(replace(walk, rig=knocked(SEED_RIG, *knock)))
            row = errors(SEED_RIG, found_without.mounting, found_without.turned["last"], found_without.shifted["last"])
            rows.append({"from": "plants", "seed": seed, "knock": knock, **row, "depth": None})
    write_results(RESULTS / "calibration.json", {"rows": rows}, ["open3d", "opencv-python-headless"])
    print("| from | seeds | knocked by | largest error | depth error | said of the last camera | a knock |")
    print("|---|---|---|---|---|---|---|")
    for source in ("boards", "plants"):
        for knock in KNOCKS:
            some = [row for row in rows if row["from"] == source and row["knock"] == knock]
            depth = max((row["depth"] for row in some if row["depth"] is not None), default=None)
            said = [row["said_degrees"] for row in some]
            print(
                f"| {source} | {len(some)} | {knock[0]:g} deg, {1e3 * knock[1]:g} mm | "
                f"{max(row['degrees'] for row in some):.2f} deg, {max(row['mm'] for row in some):.2f} mm | "
                f"{'-' if depth is None else f'{depth:.2%}'} | "
                f"{min(said):.2f} to {max(said):.2f} deg | "
                f"{sum(row['said'] for row in some)} of {len(some)} |"
            )


def knocked(rig: Rig, degrees: float, metres: float) -> Rig:
    """The rig with its last camera elsewhere."""
    last = rig.cameras["last"]
    moved = pose(
        rotation_about(AXIS, np.deg2rad(degrees)) @ last.rig_from_camera[:3, :3],
        last.rig_from_camera[:3, 3] + [0.0, metres, 0.0],
    )
    return Rig({**rig.cameras, "last": Camera(last.intrinsics, moved, last.depth_scale)}, rig.reference)


def in_memory(walk: Recording) -> Recording:
    """The recording with all of its stations rendered once."""
    stations: list[Station] = list(walk)
    return replace(walk, load=stations.__getitem__)


def errors(rig: Rig, found: Mounting, turned: float, shifted: float) -> dict[str, Any]:
    """The largest error of a camera's place, and what is said of the last one."""
    apart = [invert(camera.rig_from_camera) @ found.rig_from_camera[name] for name, camera in rig.cameras.items()]
    return {
        "degrees": max(float(np.degrees(rotation_angle(one[:3, :3]))) for one in apart),
        "mm": max(1e3 * float(np.linalg.norm(one[:3, 3])) for one in apart),
        "said_degrees": float(np.degrees(turned)),
        "said": bool(turned > 0.035 or shifted > 0.02),
    }


if __name__ == "__main__":
    main()
