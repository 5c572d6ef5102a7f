"""A simulated row written in the formats of others, imported, and reconstructed: how far is the cloud from its own?

The same walk is written by reference writers (rosbags, OpenCV, numpy) in every format that is read: by all cameras of
the rig where the format can hold them, else by the middle one; they have a quarter of a D435's pixels. The command
import makes a recording of each, with a rig file of where the cameras stand. Told is how far the points of either cloud
are from the surface of the other, 99 of 100 of them and the farthest, with poses that are estimated and, where the
format holds them, with those. Where depth is stored in another unit, readings differ by less than a micrometre. That
tips points from voxel to voxel, and the registration of a single camera in this small image into another answer; the
difference with given poses is what the format itself does.

    python benchmarks/reader_roundtrip.py
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from results_file import RESULTS, write_results
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from greenhouse_gym.capture import Recording, open_recording, simulate_recording, write_recording
from greenhouse_gym.capture.rig_file import Mounting, save_mounting
from greenhouse_gym.cli import app
from greenhouse_gym.crops import grow_row
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, reconstruct_row

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))  # the writers are those of the tests
from bag_writer import MCAP, ROS1, SQLITE, Writer, write_rig
from layouts import LAYOUTS, as_described_rig, track_of
from row_helpers import HALF

SEED, LENGTH = 1, 0.6
GIVEN = ReconstructionSettings(poses="given")
Write = Callable[[Path, Recording], None]


def main() -> None:
    """Print a table and write it to ``benchmarks/results/reader_roundtrip.json``."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulated = simulate_recording(grow_row(SEED, LENGTH), SEED, rig=HALF)
        source = open_recording(write_recording(simulated, folder / "source"))
        for cameras, formats in ((tuple(source.rig.cameras), RIGS), ((source.rig.reference,), SINGLE)):
            own = imported(folder / f"own-{len(cameras)}", source, folder / "source", {c: c for c in cameras})
            expected = reconstruct_row(own)
            for format_name, (file, named, write) in formats.items():
                place = folder / f"{format_name}-{len(cameras)}"
                place.mkdir()
                write(place / file, source)
                read = imported(place / "imported", source, place / file, {named(c): c for c in cameras})
                rows.append({"format": format_name, "cameras": len(cameras), **compared(read, own, expected)})
    write_results(
        RESULTS / "reader_roundtrip.json", {"seed": SEED, "length": LENGTH, "rows": rows}, ["open3d", "rosbags"]
    )
    print("| format | cameras | depth mm | color of 255 | poses mm | points | cloud: 99 %, most mm | poses given |")
    print("|---|---|---|---|---|---|---|---|")
    for row in rows:
        poses = "-" if row["pose_mm"] is None else f"{row['pose_mm']:.4f}"
        clouds = [f"{one['99']:.4f}, {one['most']:.4f}" if one else "-" for one in (row["estimated"], row["given"])]
        print(
            f"| {row['format']} | {row['cameras']} | {row['depth_mm']:.4f} | {row['color']} | {poses} | "
            f"{row['points']} | {' | '.join(clouds)} |"
        )


def imported(out: Path, source: Recording, path: Path, cameras: dict[str, str]) -> Recording:
    """What `greenhouse-gym import` makes of a file, whose cameras are some of the source's under other names."""
    mounting = Mounting(
        {named: source.rig.cameras[camera].rig_from_camera for named, camera in cameras.items()},
        next(named for named, camera in cameras.items() if camera == source.rig.reference),
    )
    rig = save_mounting(mounting, out.with_suffix(".yaml"))
    command = ["import", str(path), "--rig", str(rig), "--out", str(out), "--step", "0"]
    done = CliRunner().invoke(app, command, catch_exceptions=False)
    if done.exit_code:
        raise SystemExit(done.output)
    return open_recording(out)


def compared(read: Recording, own: Recording, expected: RowCloud) -> dict[str, Any]:
    """Largest differences of images, poses and cloud."""
    depth = color = 0.0
    apart: list[float] = []
    for one, other in zip(read, own, strict=True):
        for a, b in zip(one.frames.values(), other.frames.values(), strict=True):
            depth = max(depth, float(np.abs(a.depth - b.depth).max()))
            color = max(color, float(np.abs(a.color.astype(int) - b.color.astype(int)).max()))
        if one.world_from_station is not None and other.world_from_station is not None:
            apart.append(float(np.linalg.norm(one.world_from_station[:3, 3] - other.world_from_station[:3, 3])))
    row = reconstruct_row(read)
    return {
        "depth_mm": 1e3 * depth,
        "color": int(color),
        "pose_mm": 1e3 * max(apart) if apart else None,
        "points": len(row.points),
        "expected_points": len(expected.points),
        "estimated": apart_mm(row, expected),
        "given": apart_mm(*(reconstruct_row(one, GIVEN) for one in (read, own))) if apart else None,
    }


def apart_mm(row: RowCloud, other: RowCloud) -> dict[str, float]:
    """Millimetres from points of either cloud to the surface of the other."""
    gaps = 1e3 * np.concatenate([gaps_between(row, other), gaps_between(other, row)])
    return {"99": float(np.quantile(gaps, 0.99)), "most": float(gaps.max())}


def gaps_between(cloud: RowCloud, other: RowCloud) -> Array:
    """Metres from each point (n,) of a cloud to the plane of the nearest of another."""
    nearest = cKDTree(other.points).query(cloud.points)[1]
    return np.abs(((cloud.points - other.points[nearest]) * other.normals[nearest]).sum(axis=1))


def as_realsense(path: Path, source: Recording) -> None:
    """A bag as RealSense's recorder names its topics, a device for each camera."""
    stations = list(source)
    lens = source.rig.cameras[source.rig.reference].intrinsics
    with Writer(path, ROS1, lens) as bag:
        for camera in source.rig.cameras:
            bag.realsense(f"device-{camera}", [station.frames[camera] for station in stations])


def bag(container: str) -> Write:
    """What writes a bag of a container."""
    return lambda path, source: write_rig(path, container, source)


def layout(name: str) -> Write:
    """What writes a layout of a single camera."""
    return lambda path, source: LAYOUTS[name][1](path, track_of(source, source.rig.reference))


RIGS: dict[str, tuple[str, Callable[[str], str], Write]] = {
    "described": ("walk", str, as_described_rig),
    "ROS 1 bag": ("walk.bag", str, bag(ROS1)),
    "ROS 2 mcap": ("walk", str, bag(MCAP)),
    "ROS 2 db3": ("walk", str, bag(SQLITE)),
    "RealSense bag": ("walk.bag", lambda camera: f"device-{camera}", as_realsense),
}
SINGLE: dict[str, tuple[str, Callable[[str], str], Write]] = {
    name: ("walk", lambda camera: "camera", layout(name)) for name in LAYOUTS
}

if __name__ == "__main__":
    main()
