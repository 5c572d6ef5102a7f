"""Measure how well camera poses and depth errors of a rig are found, from boards and from plants alone.

python -m benchmarks.sensing.calibration

A rendered ChArUco board is photographed eight times by three cameras with blur, noise, and depth errors of 1 % and -0.6
%; without a board, eight stations of a simulated row are photographed with the usual noise. In the rig file that is
given, the last camera is at its true pose, or turned by 3 degrees and shifted by 10 mm. Reported are the largest error
of a camera's pose and the motion found for the last camera; more than 2 degrees or 20 mm is reported as a knock. Takes
2 minutes.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.common import RESULTS, TESTS, table, write_results
from greenhouse_gym.capture import SEED_RIG, Camera, Recording, Rig, simulate_recording
from greenhouse_gym.capture.boards import calibrate_from_boards
from greenhouse_gym.capture.rig_file import Mounting
from greenhouse_gym.crops import grow_row
from greenhouse_gym.geometry import invert, pose, rotation_about, rotation_angle
from greenhouse_gym.reconstruction.calibration import calibrate_from_overlap

sys.path.insert(0, str(TESTS / "capture"))
from test_boards import BIAS, BOARD, shown, true_rig

SEEDS = {"boards": range(5), "plants": range(3)}
STATIONS = 8
KNOCKS = ((0.0, 0.0), (3.0, 0.01))  # degrees, m
AXIS = np.array([0.3, 1.0, 0.2])


def main() -> None:
    """Print a table and write ``benchmarks/results/calibration.json``."""
    rows: list[dict[str, Any]] = []
    for knock in KNOCKS:
        for seed in SEEDS["boards"]:
            found: Any = calibrate_from_boards(shown(seed), knocked(true_rig(), *knock), BOARD)
            depth = max(abs(found.mounting.depth_error.get(name, 0.0) - bias) for name, bias in BIAS.items())
            rows.append({"from": "boards", "seed": seed, "knock": knock, **errors(true_rig(), found), "depth": depth})
        for seed in SEEDS["plants"]:
            recording = in_memory(simulate_recording(grow_row(seed, 0.8), seed, SEED_RIG, STATIONS))
            found = calibrate_from_overlap(replace(recording, rig=knocked(SEED_RIG, *knock)))
            rows.append({"from": "plants", "seed": seed, "knock": knock, **errors(SEED_RIG, found), "depth": None})
    write_results(RESULTS / "calibration.json", {"rows": rows})
    lines = []
    for source, seeds in SEEDS.items():
        for knock in KNOCKS:
            selected = [row for row in rows if row["from"] == source and row["knock"] == knock]
            degrees, mm = (max(row[name] for row in selected) for name in ("degrees", "mm"))
            depth = "-" if source == "plants" else f"{max(row['depth'] for row in selected):.2%}"
            found_degrees = [row["found_degrees"] for row in selected]
            knocks = f"{sum(row['knock_reported'] for row in selected)} of {len(selected)}"
            moved = f"{min(found_degrees):.2f} to {max(found_degrees):.2f} deg"
            cells = f"{knock[0]:g} deg, {1e3 * knock[1]:g} mm", f"{degrees:.2f} deg, {mm:.2f} mm", depth, moved, knocks
            lines.append((source, len(seeds), *cells))
    heads = ("from", "seeds", "knocked by", "largest error", "depth error", "motion found of the last camera", "knock")
    print(table(heads, lines))


def knocked(rig: Rig, degrees: float, metres: float) -> Rig:
    """Return the rig with its last camera turned and shifted."""
    last = rig.cameras["last"]
    moved = pose(
        rotation_about(AXIS, np.deg2rad(degrees)) @ last.rig_from_camera[:3, :3],
        last.rig_from_camera[:3, 3] + [0.0, metres, 0.0],
    )
    return Rig({**rig.cameras, "last": Camera(last.intrinsics, moved, last.depth_scale)}, rig.reference)


def in_memory(recording: Recording) -> Recording:
    """Return the recording with all of its stations rendered."""
    stations = list(recording)
    return replace(recording, load=stations.__getitem__)


def errors(rig: Rig, found: Any) -> dict[str, Any]:
    """Return the largest error of a camera's pose, and the motion that is reported for the last camera."""
    mounting: Mounting = found.mounting
    turned, shifted = found.turned["last"], found.shifted["last"]
    apart = [invert(camera.rig_from_camera) @ mounting.rig_from_camera[name] for name, camera in rig.cameras.items()]
    return {
        "degrees": max(float(np.degrees(rotation_angle(one[:3, :3]))) for one in apart),
        "mm": max(1e3 * float(np.linalg.norm(one[:3, 3])) for one in apart),
        "found_degrees": float(np.degrees(turned)),
        "knock_reported": bool(turned > 0.035 or shifted > 0.02),
    }


if __name__ == "__main__":
    main()
