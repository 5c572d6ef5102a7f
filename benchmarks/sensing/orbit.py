"""Register the frames of a real orbit, a motion for which the method is not made: nothing wrong may be accepted.

python -m benchmarks.sensing.orbit

The recording is ``d435_table`` in the folder GREENHOUSE_GYM_REAL_DATA: 16 frames of one D435 that moves around a table
and turns by about 12 degrees per step, with known poses. Each frame is registered to the previous one, from the
silhouettes as usual and from the true motion, which separates a bad start from surfaces that do not agree. Accepted
motions are compared with the poses. Takes 2 minutes.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.common import REAL_DATA, RESULTS, table, write_results
from greenhouse_gym.capture import Recording, open_recording
from greenhouse_gym.errors import ReconstructionError
from greenhouse_gym.geometry import Array, invert, rotation_angle
from greenhouse_gym.reconstruction import ReconstructionSettings
from greenhouse_gym.reconstruction.pair_registration import Registration, refine_pair, register_pair
from greenhouse_gym.reconstruction.station_registration import register_stations
from greenhouse_gym.reconstruction.station_views import Calibration, station_view

FOREGROUNDS = (0.6, 1.0, 1.5)  # m; the paper's cut, the table's far edge, and a part of the room behind
WRONG = (0.02, 2.0)  # m, degrees; the poses are accurate to some millimetres


def main() -> None:
    """Print tables and write ``benchmarks/results/orbit.json``."""
    folder = REAL_DATA / "d435_table"
    if not folder.is_dir():
        print("skipped: GREENHOUSE_GYM_REAL_DATA names no folder that holds d435_table")
        return
    recording = open_recording(folder)
    results = {
        f"{cut:g} m": measure(recording, replace(ReconstructionSettings(), foreground=cut)) for cut in FOREGROUNDS
    }
    write_results(RESULTS / "orbit.json", {"wrong_beyond": WRONG, "foreground": results})
    if any(result["accepted_wrong"] for result in results.values()):
        sys.exit("a wrong motion was accepted")


def measure(recording: Recording, settings: ReconstructionSettings) -> dict[str, Any]:
    """Register all pairs of neighbors, and reconstruct the whole recording, with one foreground."""
    views = [station_view(station, Calibration(recording.rig), settings) for station in recording]
    poses = np.array([station.world_from_station for station in recording], dtype=np.float64)
    pairs = []
    for i, (first, second) in enumerate(pairwise(views)):
        true = invert(poses[i]) @ poses[i + 1]
        pairs.append(
            {
                "pair": [i, i + 1],
                "moved": 1e2 * float(np.linalg.norm(true[:3, 3])),
                "turned": float(np.degrees(rotation_angle(true[:3, :3]))),
                "registered": outcome(register_pair(first, second, 1, settings), true),
                "from_the_true_motion": outcome(refine_pair(first, second, true, 1, 0.0, settings), true),
            }
        )
    starts = ("registered", "from_the_true_motion")
    walked = path(recording, poses, settings)
    tried = [pair[start] for pair in pairs for start in starts] + walked["edges"]
    result: dict[str, Any] = {
        "foreground_fraction": float(np.mean([view.reference.foreground.mean() for view in views])),
        "accepted": sum(pair["registered"]["accepted"] for pair in pairs),
        "accepted_wrong": sum(found["accepted"] and found["wrong"] for found in tried),
        "path": walked,
        "pairs": pairs,
    }
    fraction = f"{result['foreground_fraction']:.0%} of the image"
    print(f"\nforeground up to {settings.foreground:g} m, {fraction}; the path: {walked['ends']}")
    error = "error mm / deg"
    print(
        table(
            ("pair", "moved cm", "turned deg", "outcome", error, "from the true motion", error),
            [
                (
                    f"{pair['pair'][0]}-{pair['pair'][1]}", f"{pair['moved']:.1f}", f"{pair['turned']:.1f}",
                    *(cell for start in starts for cell in cells(pair[start])),
                )
                for pair in pairs
            ],
        )
    )  # fmt: skip
    print(f"accepted {result['accepted']} of {len(pairs)}, wrong ones among all accepted: {result['accepted_wrong']}")
    return result


def outcome(found: Registration, true: Array) -> dict[str, Any]:
    """Return a registration's verdict and its error."""
    verdict = {"accepted": found.accepted, "reason": found.reason, "fitness": found.fitness}
    return verdict | errors(found.first_from_second, true)


def errors(motion: Array, true: Array) -> dict[str, Any]:
    """Return the difference between a motion and the true one."""
    metres = float(np.linalg.norm(motion[:3, 3] - true[:3, 3]))
    degrees = float(np.degrees(rotation_angle(motion[:3, :3].T @ true[:3, :3])))
    return {"mm": 1e3 * metres, "degrees": degrees, "wrong": metres > WRONG[0] or degrees > WRONG[1]}


def cells(found: dict[str, Any]) -> tuple[str, str]:
    """Return an outcome and its error as text."""
    verdict = f"accepted, fitness {found['fitness']:.2f}" if found["accepted"] else f"refused: {found['reason']}"
    return verdict, f"{found['mm']:.1f} / {found['degrees']:.2f}"


def path(recording: Recording, poses: Array, settings: ReconstructionSettings) -> dict[str, Any]:
    """Reconstruct the whole recording; return its end and every motion that was accepted."""
    try:
        walked = register_stations(recording, settings)
    except ReconstructionError as refusal:
        return {"ends": str(refusal).partition(". ")[0], "edges": []}
    edges = [
        {"pair": [i, j], "accepted": True} | errors(edge.first_from_second, invert(poses[i]) @ poses[j])
        for (i, j), edge in walked.edges.items()
    ]
    return {"ends": f"segments of {', '.join(str(len(s)) for s in walked.segments)} stations", "edges": edges}


if __name__ == "__main__":
    main()
