"""Check what is found automatically in recordings and clouds: foreground, sensor noise, direction, units, upright axis.

python -m benchmarks.sensing.automatic_settings

Foreground: for every protocol's rig, the cut is right if it lies at least 5 cm behind the stems and before the next
row. Direction: a step of a pass is reconstructed both ways along the row, with only the rig's calibration known;
direction and length are right if the second station is within 10 mm of its true position. Clouds: the cloud of that
pass is read like a file of unknown origin, in millimetres, centimetres or metres, with y up, upside down, or in any
orientation; checked are units, upright axis, up end of that axis, and the side from which it was scanned. If only the
fruit shows which end is up, shapes are extracted first. Real recordings and clouds in the folder
GREENHOUSE_GYM_REAL_DATA are read as they are. Takes 5 minutes.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.common import REAL_DATA, RESULTS, table, write_results
from benchmarks.sensing.real_clouds import CYLINDERS, read_table
from greenhouse_gym.build.scans import RawCloud, extract_from_scan, open_scan
from greenhouse_gym.capture import PROTOCOLS, CaptureProtocol, Recording, Rig, open_recording, simulate_protocol
from greenhouse_gym.crops import grow_row
from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.geometry import Array, invert
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, reconstruct_row, settings_for
from greenhouse_gym.reconstruction.settings import sensor_noise
from greenhouse_gym.shapes import ShapeWarning

SEEDS, LENGTH, STATIONS = (2, 3), 0.6, 2
NEXT_ROW = 0.5  # m, minimum distance of the next row's pipes and plants behind the stems
NEAR = 0.010  # m
UPRIGHT = np.cos(np.deg2rad(10.0))
FORMS: dict[str, tuple[float, Array]] = {  # units per metre, file_from_row
    "mm, y up": (1000.0, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])),
    "m, upside down": (1.0, np.diag([1.0, -1.0, -1.0])),
    "cm, any orientation": (100.0, Rotation.from_rotvec([0.7, -0.4, 1.1]).as_matrix()),
}
Figures = dict[str, Any]


def main() -> None:
    """Print three tables and write ``benchmarks/results/automatic_settings.json``."""
    warnings.simplefilter("ignore", ShapeWarning)
    cuts = list(foregrounds())
    walks, clouds = [], []
    for protocol in PROTOCOLS.values():
        row_pass = first_pass(protocol)
        walks += [walked(row_pass, direction, protocol.name) for direction in ("forward", "backward")]
        row = reconstruct_row(row_pass, ReconstructionSettings(foreground=protocol.foreground, poses="given"))
        clouds += [{"cloud": protocol.name, **read_as_file(row, form)} for form in FORMS]
    clouds += list(real_clouds())
    write_results(RESULTS / "automatic_settings.json", {"cuts": cuts, "walks": walks, "clouds": clouds})
    print(
        table(
            ("recording", "stems m", "cut m", "readings kept", "noise mm", "correspondences within mm", "right"),
            [
                (
                    cut["recording"], cut["stems"] or "-", f"{cut['cut']:.2f}", f"{cut['kept']:.0%}",
                    f"{1e3 * cut['noise']:.2f}", f"{1e3 * cut['correspondence_distance']:.1f}", cut["right"],
                )
                for cut in cuts
            ],
        )
    )  # fmt: skip
    columns = ("row_pass", "order", "direction", "went", "true", "wrong_mm", "right", "refused")
    print("\n" + table(columns, [[_cell(one.get(name, "")) for name in columns] for one in walks]))
    columns = ("cloud", "form", "units", "axis", "end", "side")
    print("\n" + table((*columns, "notes"), [[*(one[n] for n in columns), "; ".join(one["notes"])] for one in clouds]))


def _cell(value: Any) -> str:
    return f"{value:.3f}" if isinstance(value, float) else str(value)


# -- foreground and noise ---------------------------------------------------------------------------------------------


def foregrounds() -> Iterator[Figures]:
    """Yield the cut and the noise found in recordings of every protocol, and in real ones."""
    for name, protocol in PROTOCOLS.items():
        for seed in SEEDS:
            recording = simulate_protocol(grow_row(seed, LENGTH), seed, reference_cameras(protocol), stations=1)
            found = foreground(replace(recording, protocol=None))
            right = protocol.distance + 0.05 <= found["cut"] <= protocol.distance + NEXT_ROW
            yield {"recording": f"{name}, row {seed}", "stems": protocol.distance, **found, "right": bool(right)}
    for name in ("d435_table", "open3d_rgbd"):
        if (REAL_DATA / name).is_dir():
            found = foreground(open_recording(REAL_DATA / name))
            yield {"recording": name, "stems": None, **found, "right": None}


def reference_cameras(protocol: CaptureProtocol) -> CaptureProtocol:
    """Return the protocol with its reference cameras only; they decide about the cut."""
    passes = (Rig({rig.reference: rig.cameras[rig.reference]}, rig.reference) for rig in protocol.passes)
    return replace(protocol, passes=tuple(passes))


def foreground(recording: Recording) -> Figures:
    """Return the cut and the noise that are found in a recording."""
    settings = settings_for(recording)
    camera = recording.rig.cameras[recording.rig.reference]
    frame = recording[0].frames[recording.rig.reference]
    return {
        "cut": settings.foreground,
        "kept": float(np.mean(frame.depth[frame.depth > 0] < settings.foreground)),
        "noise": sensor_noise([frame], camera, recording.rig, settings.foreground),
        "correspondence_distance": settings.fine_distance,
    }


# -- direction --------------------------------------------------------------------------------------------------------


def first_pass(protocol: CaptureProtocol) -> Recording:
    """Return the first pass of a protocol, without the protocol's name."""
    first_pass = replace(protocol, passes=protocol.passes[:1])
    row_pass = simulate_protocol(grow_row(SEEDS[0], LENGTH), SEEDS[0], first_pass, stations=STATIONS)
    stations = list(row_pass)
    return replace(row_pass, protocol=None, load=stations.__getitem__)


def walked(row_pass: Recording, order: str, name: str) -> Figures:
    """Reconstruct a row_pass, or the same from its end, with the settings found in its images."""
    if order == "backward":
        row_pass = replace(row_pass, load=lambda i, there=row_pass.load: there(STATIONS - 1 - i), truth=None)
    first, last = (np.asarray(row_pass[i].world_from_station) for i in (0, STATIONS - 1))
    true = invert(first) @ last
    figures: Figures = {"row_pass": name, "order": order, "true": float(true[1, 3])}
    try:
        row = reconstruct_row(row_pass, settings_for(row_pass))
        refused = None if row.registered[-1] else str(row.report.stations[-1].reason)
    except GreenhouseError as error:
        refused = str(error)[:120]
    if refused is not None:
        return figures | {"direction": None, "refused": refused, "right": False}
    found = row.world_from_station[-1]
    wrong = float(np.linalg.norm(found[:3, 3] - true[:3, 3]))
    direction = "right" if found[1, 3] * true[1, 3] > 0 else "wrong"
    return figures | {
        "went": float(found[1, 3]),
        "wrong_mm": 1e3 * wrong,
        "right": wrong < NEAR,
        "direction": direction,
    }


# -- units and orientation --------------------------------------------------------------------------------------------


def read_as_file(row: RowCloud, form: str) -> Figures:
    """Check what is found in a row's cloud in one of the `FORMS`."""
    per_metre, file_from_row = FORMS[form]
    raw = RawCloud(per_metre * row.points @ file_from_row.T, row.colors, row.normals @ file_from_row.T)
    opened = open_scan(raw)
    scan = extract_from_scan(opened)[0] if form == "m, upside down" else opened
    turn = scan.row_from_file[:3, :3] @ file_from_row
    return {
        "form": form,
        "units": bool(np.isclose(scan.unit * per_metre, 1.0)),
        "axis": bool(abs(turn[2, 2]) > UPRIGHT),
        "end": bool(turn[2, 2] > UPRIGHT),
        "side": bool(turn[0, 0] > UPRIGHT),
        "notes": list(scan.notes),
    }


def real_clouds() -> Iterator[Figures]:
    """Yield the same for tables seen by a Kinect (m, y down) and seedlings (mm, z up)."""
    if not REAL_DATA.is_dir():
        return
    for name in CYLINDERS:
        up = np.asarray(read_table(REAL_DATA, name).camera_from_world[:3, 2])
        yield read_real(REAL_DATA / "cylinders" / f"{name}.pcd", 1.0, up)
    for file in sorted((REAL_DATA / "tomato_seedlings").glob("03-*")):
        if file.suffix in (".xyz", ".ply"):
            yield read_real(file, 0.001, np.array([0.0, 0.0, 1.0]))


def read_real(file: Path, unit: float, up: Array) -> Figures:
    """Check what is found in a real file; the side from which it was seen is not known."""
    scan = open_scan(file)
    found = float(scan.row_from_file[2, :3] @ up)
    return {
        "cloud": file.name, "form": "as it is", "units": bool(np.isclose(scan.unit, unit)),
        "axis": bool(abs(found) > UPRIGHT), "end": bool(found > UPRIGHT), "side": None, "notes": list(scan.notes),
    }  # fmt: skip


if __name__ == "__main__":
    main()
