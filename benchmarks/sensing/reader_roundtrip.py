"""Write a simulated row in the formats of others, import and reconstruct it, and compare the clouds.

python -m benchmarks.sensing.reader_roundtrip

One walk is written by reference writers (rosbags, OpenCV, numpy) in every format that is read: by all cameras of the
rig if the format can hold them, else by the middle one; they have a quarter of a D435's pixels. ``greenhouse-gym
import`` makes a recording of each, with a rig file. Reported are the distances from the points of either cloud to the
surface of the other (99 of 100 points, and the maximum), with estimated and, if the format holds them, with given
poses. Depth stored in another unit differs by less than a micrometre; that moves points between voxels, and changes the
registration of a single camera with such a small image. With given poses only the format itself makes a difference.
Takes 10 minutes.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from benchmarks.common import RESULTS, TESTS, table, write_results
from greenhouse_gym.capture import Recording, open_recording, simulate_recording, write_recording
from greenhouse_gym.capture.rig_file import Mounting, save_mounting
from greenhouse_gym.cli import app
from greenhouse_gym.crops import grow_row
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, reconstruct_row

sys.path.insert(0, str(TESTS))
from bag_writer import MCAP, ROS1, SQLITE, Writer, write_rig
from layouts import LAYOUTS, as_described_rig, track_of
from row_helpers import HALF

SEED, LENGTH = 1, 0.6
MIDDLE = HALF.reference
GIVEN = ReconstructionSettings(poses="given")
Format = tuple[str, Callable[[str], str], Callable[[Path, Recording], None]]  # file, camera names in it, writer


def main() -> None:
    """Print a table and write ``benchmarks/results/reader_roundtrip.json``."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulated = simulate_recording(grow_row(SEED, LENGTH), SEED, rig=HALF)
        source = open_recording(write_recording(simulated, folder / "source"))
        for cameras, formats in ((tuple(source.rig.cameras), RIGS), ((source.rig.reference,), SINGLE)):
            own = imported(folder / f"own-{len(cameras)}", source, folder / "source", {c: c for c in cameras})
            expected = reconstruct_row(own)
            for format_name, (file, named, write) in formats.items():
                subfolder = folder / f"{format_name}-{len(cameras)}"
                subfolder.mkdir()
                write(subfolder / file, source)
                read = imported(subfolder / "imported", source, subfolder / file, {named(c): c for c in cameras})
                rows.append({"format": format_name, "cameras": len(cameras), **compared(read, own, expected)})
    write_results(RESULTS / "reader_roundtrip.json", {"seed": SEED, "length": LENGTH, "rows": rows})
    heads = ("format", "cameras", "depth mm", "color of 255", "poses mm", "points", "99 %, maximum mm", "poses given")
    lines = []
    for row in rows:
        poses = "-" if row["pose_mm"] is None else f"{row['pose_mm']:.4f}"
        clouds = [f"{one['99']:.4f}, {one['maximum']:.4f}" if one else "-" for one in (row["estimated"], row["given"])]
        depth = f"{row['depth_mm']:.4f}"
        lines.append((row["format"], row["cameras"], depth, row["color"], poses, row["points"], *clouds))
    print(table(heads, lines))


def imported(out: Path, source: Recording, path: Path, cameras: dict[str, str]) -> Recording:
    """Import a file whose cameras are some of the source's under other names."""
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
    """Return the largest differences of images, poses and clouds."""
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
    """Return quantiles of the distances from the points of either cloud to the surface of the other, mm."""
    gaps = 1e3 * np.concatenate([distances(row, other), distances(other, row)])
    return {"99": float(np.quantile(gaps, 0.99)), "maximum": float(gaps.max())}


def distances(cloud: RowCloud, other: RowCloud) -> Array:
    """Return the distance (n,) from each point of a cloud to the plane of the nearest point of another, m."""
    nearest = cKDTree(other.points).query(cloud.points)[1]
    return np.abs(((cloud.points - other.points[nearest]) * other.normals[nearest]).sum(axis=1))


def write_realsense(path: Path, source: Recording) -> None:
    """Write a bag with RealSense's names of topics, one device per camera."""
    stations = list(source)
    lens = source.rig.cameras[source.rig.reference].intrinsics
    with Writer(path, ROS1, lens) as bag:
        for camera in source.rig.cameras:
            bag.realsense(f"device-{camera}", [station.frames[camera] for station in stations])


RIGS: dict[str, Format] = {
    "described": ("walk", str, as_described_rig),
    "ROS 1 bag": ("walk.bag", str, lambda path, source: write_rig(path, ROS1, source)),
    "ROS 2 mcap": ("walk", str, lambda path, source: write_rig(path, MCAP, source)),
    "ROS 2 db3": ("walk", str, lambda path, source: write_rig(path, SQLITE, source)),
    "RealSense bag": ("walk.bag", lambda camera: f"device-{camera}", write_realsense),
}
SINGLE: dict[str, Format] = {
    name: ("walk", lambda camera: "camera", lambda path, source, write=write: write(path, track_of(source, MIDDLE)))
    for name, (_, write, *_) in LAYOUTS.items()
}

if __name__ == "__main__":
    main()
