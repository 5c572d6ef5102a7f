"""Register the frames of a real orbit, which is outside the sideways motion the method is for.

The recording is the folder ``d435_table`` in the folder that the environment variable GREENHOUSE_GYM_REAL_DATA names:
16 frames of one D435 that goes around a table, turning by about 12 degrees a step, with known poses. Each frame is
registered to the one before it, from the silhouettes as always, and, to tell a bad start from surfaces that do not
agree, from the true motion as well. What is accepted is compared with the poses.

    python benchmarks/orbit.py
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from results_file import RESULTS, write_results

from greenhouse_gym.capture import Recording, open_recording
from greenhouse_gym.errors import ReconstructionError
from greenhouse_gym.geometry import Array, invert, rotation_angle
from greenhouse_gym.reconstruction import ReconstructionSettings
from greenhouse_gym.reconstruction.pair_registration import Registration, refine_pair, register_pair
from greenhouse_gym.reconstruction.station_registration import register_stations
from greenhouse_gym.reconstruction.station_views import Calibration, station_view

FOREGROUNDS = (0.6, 1.0, 1.5)  # m; the paper's cut, the table's far edge, and some of the room behind
WRONG = (0.02, 2.0)  # m, degrees; the poses are known to some millimetres


def main() -> None:
    """Print a table and write it to ``benchmarks/results/orbit.json``."""
    folder = Path(os.environ.get("GREENHOUSE_GYM_REAL_DATA", "/nonexistent")) / "d435_table"
    if not folder.is_dir():
        print("skipped: GREENHOUSE_GYM_REAL_DATA names no folder that holds d435_table")
        return
    recording = open_recording(folder)
    results = {
        f"{cut:g} m": measure(recording, replace(ReconstructionSettings(), foreground=cut)) for cut in FOREGROUNDS
    }
    write_results(RESULTS / "orbit.json", {"wrong_beyond": WRONG, "foreground": results}, ["open3d"])
    if any(result["accepted_wrong"] for result in results.values()):
        sys.exit("a wrong motion was accepted")


def measure(recording: Recording, settings: ReconstructionSettings) -> dict[str, Any]:
    """All pairs of neighbors, and the whole walk, with one foreground."""
    stations = list(recording)
    views = [station_view(station, Calibration(recording.rig), settings) for station in stations]
    poses = np.array([station.world_from_station for station in stations], dtype=np.float64)
    pairs = []
    for i, (first, second) in enumerate(pairwise(views)):
        true = invert(poses[i]) @ poses[i + 1]
        started = perf_counter()
        found = register_pair(first, second, 1, settings)
        seconds = perf_counter() - started
        pairs.append(
            {
                "pair": [i, i + 1],
                "moved": 1e2 * float(np.linalg.norm(true[:3, 3])),
                "turned": float(np.degrees(rotation_angle(true[:3, :3]))),
                "registered": outcome(found, true),
                "from_the_true_motion": outcome(refine_pair(first, second, true, 1, 0.0, settings), true),
                "seconds": seconds,
            }
        )
    starts = ("registered", "from_the_true_motion")
    walked = walk(recording, poses, settings)
    tried = [pair[start] for pair in pairs for start in starts] + walked["edges"]
    result: dict[str, Any] = {
        "foreground_share": float(np.mean([view.reference.foreground.mean() for view in views])),
        "accepted": sum(pair["registered"]["accepted"] for pair in pairs),
        "accepted_wrong": sum(found["accepted"] and found["wrong"] for found in tried),
        "walk": walked,
        "pairs": pairs,
    }
    share = f"{result['foreground_share']:.0%} of the image"
    print(f"\nforeground up to {settings.foreground:g} m, {share}; the walk: {walked['ends']}")
    print("| pair | moved cm | turned deg | outcome | error mm / deg | from the true motion | error mm / deg |")
    print("|---|---|---|---|---|---|---|")
    for pair in pairs:
        moved = f"{pair['pair'][0]}-{pair['pair'][1]} | {pair['moved']:.1f} | {pair['turned']:.1f}"
        cells = [f"{text(pair[start])} | {pair[start]['mm']:.1f} / {pair[start]['degrees']:.2f}" for start in starts]
        print(f"| {moved} | {' | '.join(cells)} |")
    print(f"accepted {result['accepted']} of {len(pairs)}, wrong ones among all accepted: {result['accepted_wrong']}")
    return result


def outcome(found: Registration, true: Array) -> dict[str, Any]:
    """What became of a registration, and how far it is from the true motion."""
    told = {"accepted": found.accepted, "reason": found.reason, "fitness": found.fitness}
    return told | error(found.first_from_second, true)


def error(motion: Array, true: Array) -> dict[str, Any]:
    """How far a motion is from the true one."""
    metres = float(np.linalg.norm(motion[:3, 3] - true[:3, 3]))
    degrees = float(np.degrees(rotation_angle(motion[:3, :3].T @ true[:3, :3])))
    return {"mm": 1e3 * metres, "degrees": degrees, "wrong": metres > WRONG[0] or degrees > WRONG[1]}


def text(result: dict[str, Any]) -> str:
    """An outcome in a cell."""
    return f"accepted, fitness {result['fitness']:.2f}" if result["accepted"] else f"refused: {result['reason']}"


def walk(recording: Recording, poses: Array, settings: ReconstructionSettings) -> dict[str, Any]:
    """How the reconstruction of the whole recording ends, and every motion it accepted."""
    try:
        walked = register_stations(recording, settings)
    except ReconstructionError as refusal:
        return {"ends": str(refusal).partition(". ")[0], "edges": []}
    edges = [
        {"pair": [i, j], "accepted": True} | error(edge.first_from_second, invert(poses[i]) @ poses[j])
        for (i, j), edge in walked.edges.items()
    ]
    return {"ends": f"segments of {', '.join(str(len(s)) for s in walked.segments)} stations", "edges": edges}


if __name__ == "__main__":
    main()
