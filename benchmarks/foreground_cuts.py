"""Where the foreground's cut is put by the depths of a recording alone, on every protocol's rig and on real sets.

A simulated cut is right if it lies behind the stems by 5 cm or more and before the next row. Of real sets, in the
folder that GREENHOUSE_GYM_REAL_DATA names, it is shown what the cut keeps. The noise of the readings is told as well.

    python benchmarks/foreground_cuts.py
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from results_file import RESULTS, write_results

from greenhouse_gym.capture import PROTOCOLS, CaptureProtocol, Recording, Rig, open_recording, simulate_protocol
from greenhouse_gym.crops import grow_row
from greenhouse_gym.reconstruction import settings_for
from greenhouse_gym.reconstruction.fitting import sensor_noise

SEEDS = (2, 3)
NEXT_ROW = 0.5  # m behind the stems that the next row's pipes and plants are away from, at least
REAL = ("d435_table", "open3d_rgbd")


def main() -> None:
    """Print a table and write it to ``benchmarks/results/foreground_cuts.json``."""
    rows = []
    for name, protocol in PROTOCOLS.items():
        for seed in SEEDS:
            recording = simulate_protocol(grow_row(seed, 0.6), seed, alone(protocol), stations=1)
            found = measured(replace(recording, protocol=None))
            right = protocol.distance + 0.05 <= found["cut"] <= protocol.distance + NEXT_ROW
            rows.append({"recording": f"{name}, row {seed}", "stems": protocol.distance, **found, "right": bool(right)})
    folder = Path(os.environ.get("GREENHOUSE_GYM_REAL_DATA", "/nonexistent"))
    rows += [
        {"recording": name, "stems": None, **measured(open_recording(folder / name)), "right": None}
        for name in REAL
        if (folder / name).is_dir()
    ]
    write_results(RESULTS / "foreground_cuts.json", {"rows": rows}, ["open3d"])
    print("| recording | stems m | cut m | readings kept | noise mm | partners within mm | right |")
    print("|---|---|---|---|---|---|---|")
    for row in rows:
        figures = f"{row['cut']:.2f} | {row['kept']:.0%} | {1e3 * row['noise']:.2f} | {1e3 * row['partners']:.1f}"
        print(f"| {row['recording']} | {row['stems'] or '-'} | {figures} | {row['right']} |")


def alone(protocol: CaptureProtocol) -> CaptureProtocol:
    """The protocol with the reference cameras only: those tell the cut."""
    return replace(
        protocol,
        passes=tuple(Rig({rig.reference: rig.cameras[rig.reference]}, rig.reference) for rig in protocol.passes),
    )


def measured(recording: Recording) -> dict[str, Any]:
    """The cut and the noise that a recording itself tells."""
    settings = settings_for(recording)
    camera = recording.rig.cameras[recording.rig.reference]
    frame = recording[0].frames[recording.rig.reference]
    readings = frame.depth[frame.depth > 0]
    return {
        "cut": settings.foreground,
        "kept": float(np.mean(readings < settings.foreground)),
        "noise": sensor_noise([frame], camera, recording.rig, settings.foreground),
        "partners": settings.fine_distance,
    }


if __name__ == "__main__":
    main()
