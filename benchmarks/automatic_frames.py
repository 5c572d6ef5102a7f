"""What is found out without being told, beside the foreground's cut (foreground_cuts.py): direction, units, up.

Of every protocol's rig a step of the walk is reconstructed both ways along the row, with nothing known but where the
cameras stand on the rig: direction and length are right if the second station is within 10 mm of where it was. The
cloud of that walk then is a cloud from elsewhere, in millimetres, centimetres or metres, with y up, upside down, or
turned any way: are units, the axis that is upright, the end of it that is up, and the side it was seen from, right?
Which end is up is told by the fruit where nothing else does, so of what is upside down shapes are looked for. Real
clouds, in the folder that GREENHOUSE_GYM_REAL_DATA names, are read as they are. Three minutes.

    python benchmarks/automatic_frames.py
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from results_file import RESULTS, write_results
from scipy.spatial.transform import Rotation
from shapes_real_data import CYLINDERS, read_table

from greenhouse_gym.build.scans import RawCloud, extract_from_scan, open_scan
from greenhouse_gym.capture import PROTOCOLS, CaptureProtocol, Recording, simulate_protocol
from greenhouse_gym.crops import grow_row
from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.geometry import Array, invert
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, reconstruct_row, settings_for
from greenhouse_gym.shapes import ShapeWarning

SEED, LENGTH, STATIONS = 2, 0.6, 2
NEAR = 0.010  # m
UPRIGHT = np.cos(np.deg2rad(10.0))
FORMS: dict[str, tuple[float, Array]] = {  # units to a metre, file_from_row
    "mm, y up": (1000.0, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])),
    "m, upside down": (1.0, np.diag([1.0, -1.0, -1.0])),
    "cm, any way": (100.0, Rotation.from_rotvec([0.7, -0.4, 1.1]).as_matrix()),
}


def main() -> None:
    """Print two tables and write them to ``benchmarks/results/automatic_frames.json``."""
    warnings.simplefilter("ignore", ShapeWarning)
    walks, clouds = [], []
    for protocol in PROTOCOLS.values():
        walk = first_walk(protocol)
        walks += [walked(walk, way, protocol.name) for way in ("forward", "backward")]
        row = reconstruct_row(walk, ReconstructionSettings(foreground=protocol.foreground, poses="given"))
        clouds += [{"cloud": protocol.name, **as_file(row, form)} for form in FORMS]
    clouds += list(real_clouds(Path(os.environ.get("GREENHOUSE_GYM_REAL_DATA", "/nonexistent"))))
    print("| walk | way | direction | went m | of m | wrong by mm | right |")
    print("|---|---|---|---|---|---|---|")
    for one in walks:
        figures = f"{one['went']:.3f} | {one['true']:.3f} | {one['wrong_mm']:.1f}" if "went" in one else one["refused"]
        print(f"| {one['walk']} | {one['way']} | {one['direction']} | {figures} | {one['right']} |")
    print("\n| cloud | as | units | upright axis | up end | side | what was said |")
    print("|---|---|---|---|---|---|---|")
    for one in clouds:
        marks = " | ".join(str(one[name]) for name in ("units", "axis", "end", "side"))
        print(f"| {one['cloud']} | {one['form']} | {marks} | {'; '.join(one['said'])} |")
    write_results(RESULTS / "automatic_frames.json", {"walks": walks, "clouds": clouds}, ["open3d"])


def first_walk(protocol: CaptureProtocol) -> Recording:
    """The first pass of a protocol, which does not say that it follows one."""
    alone = replace(protocol, passes=protocol.passes[:1])
    walk = simulate_protocol(grow_row(SEED, LENGTH), SEED, alone, stations=STATIONS)
    stations = list(walk)
    return replace(walk, protocol=None, load=stations.__getitem__)


def walked(walk: Recording, way: str, name: str) -> dict[str, Any]:
    """How a walk, or the same from its end, is reconstructed with the settings that its images tell."""
    if way == "backward":
        walk = replace(walk, load=lambda i, there=walk.load: there(STATIONS - 1 - i), truth=None)
    first, last = (np.asarray(walk[i].world_from_station) for i in (0, STATIONS - 1))
    true = invert(first) @ last
    told: dict[str, Any] = {"walk": name, "way": way, "true": float(true[1, 3])}
    try:
        row = reconstruct_row(walk, settings_for(walk))
        found = row.world_from_station[-1]
    except GreenhouseError as error:
        return told | {"direction": None, "refused": str(error)[:120], "right": False}
    if not row.registered[-1]:
        return told | {"direction": None, "refused": str(row.report.stations[-1].reason), "right": False}
    wrong = float(np.linalg.norm(found[:3, 3] - true[:3, 3]))
    return told | {
        "went": float(found[1, 3]), "wrong_mm": 1e3 * wrong, "right": wrong < NEAR,
        "direction": "right" if found[1, 3] * true[1, 3] > 0 else "wrong",
    }  # fmt: skip


def as_file(row: RowCloud, form: str) -> dict[str, Any]:
    """What is found out about a row's cloud as somebody else's file would hold it."""
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
        "said": list(scan.notes),
    }


def real_clouds(folder: Path) -> Iterator[dict[str, Any]]:
    """Tables before a Kinect, metres, y down; seedlings in millimetres, z up."""
    if not folder.is_dir():
        return
    for name in CYLINDERS:
        up = np.asarray(read_table(folder, name).camera_from_world[:3, 2])
        yield real(folder / "cylinders" / f"{name}.pcd", 1.0, up)
    for file in sorted((folder / "tomato_seedlings").glob("03-*")):
        if file.suffix in (".xyz", ".ply"):
            yield real(file, 0.001, np.array([0.0, 0.0, 1.0]))


def real(file: Path, unit: float, up: Array) -> dict[str, Any]:
    """What is found out about a real file; nobody knows from where a seedling was seen."""
    scan = open_scan(file)
    found = float(scan.row_from_file[2, :3] @ up)
    return {
        "cloud": file.name, "form": "as it is", "units": bool(np.isclose(scan.unit, unit)),
        "axis": bool(abs(found) > UPRIGHT), "end": bool(found > UPRIGHT), "side": None, "said": list(scan.notes),
    }  # fmt: skip


if __name__ == "__main__":
    main()
