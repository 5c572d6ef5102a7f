"""Readers of real clouds: tables with labeled cans and mugs, and scanned tomato seedlings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture import Intrinsics
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.geometry import Array, invert, pose, transform
from greenhouse_gym.reconstruction.station_views import image_normals

KINECT = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)

CYLINDERS = {"learn33": (50, 61), "test31": (30, 40), "test35": (30, 40, 50), "test43": (60, 70), "test50": (40, 80)}
"""Labels of the cans and of the outsides of the mugs; bowls and flat tins do not count as cylinders."""

JUNCTION, MAIN, STALK = 2, 7, 9
"""Classes of the labeled seedlings' points: junctions of leaves and stem, main stem, stalks of leaves."""

_GREEN = np.array([0.35, 0.5, 0.2])


@dataclass(frozen=True, eq=False)
class TableScene:
    """A table seen by a Kinect, in a frame with z up and x away from the camera, m.

    Attributes:
        name: Name of its file.
        points: (n, 3).
        colors: (n, 3) RGB in [0, 1].
        normals: (n, 3) unit vectors, toward the camera.
        labels: (n,) number of each point's object.
        camera_from_world: (4, 4).
    """

    name: str
    points: Array
    colors: Array
    normals: Array
    labels: npt.NDArray[np.int64]
    camera_from_world: Array


@dataclass(frozen=True, eq=False)
class Seedling:
    """A scanned seedling, scaled to a given height.

    Attributes:
        name: Name of its file.
        points: (n, 3) m, z up, the lowest at 0.
        colors: (n, 3) RGB in [0, 1]; one green where the scan has none.
        scale: Factor from the file's unit to m at the given height.
        skeleton: (k, 2, 3) ends of the skeleton's edges, or None.
        labels: (n,) class of each point, or None.
    """

    name: str
    points: Array
    colors: Array
    scale: float
    skeleton: Array | None = None
    labels: npt.NDArray[np.int64] | None = None


def read_table(folder: Path, name: str) -> TableScene:
    """Read one of the `CYLINDERS` tables; up is the normal of the points labeled as table."""
    cloud = open3d().t.io.read_point_cloud(str(Path(folder) / "cylinders" / f"{name}.pcd"))
    points = cloud.point["positions"].numpy().astype(np.float64)
    valid = np.isfinite(points).all(axis=1) & (np.nan_to_num(points[:, 2]) > 0.1)
    points, labels = points[valid], cloud.point["label"].numpy().ravel()[valid].astype(np.int64)
    colors = cloud.point["colors"].numpy()[valid]
    row, v, u = KINECT.project(points)
    depth = np.zeros((KINECT.height, KINECT.width), dtype=np.float32)
    depth[v, u] = points[row, 2]
    normals = np.zeros((*depth.shape, 3))
    normals[depth > 0] = image_normals(depth, depth > 0, KINECT)

    table = points[row][labels[row] == 1]
    up = np.linalg.svd(table - table.mean(axis=0), full_matrices=False)[2][2]
    up = -np.sign(up[1]) * up  # the camera's y points down
    ahead = np.array([0.0, 0.0, 1.0]) - up[2] * up
    ahead /= np.linalg.norm(ahead)
    world_from_camera = pose(np.stack([ahead, np.cross(up, ahead), up]))
    return TableScene(
        name,
        transform(world_from_camera, points[row]),
        colors[row] / 255.0,
        normals[v, u] @ world_from_camera[:3, :3].T,
        labels[row],
        invert(world_from_camera),
    )


def read_seedlings(folder: Path, height: float) -> list[Seedling]:
    """Read all seedlings and scale each to a height, m."""
    here = Path(folder) / "tomato_seedlings"
    plants = []
    for file in [*sorted(here.glob("03-*.xyz")), *sorted(here.glob("03-*.ply"))]:
        points = (
            np.loadtxt(file) if file.suffix == ".xyz" else np.asarray(open3d().io.read_point_cloud(str(file)).points)
        )
        edges = _skeleton(file.with_suffix(".graph.txt"))
        plants.append(_scaled(file.stem, points, np.tile(_GREEN, (len(points), 1)), height, skeleton=edges))
    for file in sorted(here.glob("BFS_*.txt")):
        table = np.loadtxt(file)
        plants.append(
            _scaled(file.stem, table[:, :3], table[:, 3:6] / 255.0, height, labels=table[:, 6].astype(np.int64))
        )
    return plants


def _scaled(
    name: str,
    points: Array,
    colors: Array,
    height: float,
    skeleton: Array | None = None,
    labels: npt.NDArray[np.int64] | None = None,
) -> Seedling:
    scale = height / float(np.ptp(points[:, 2]))
    origin = np.array([*points[:, :2].mean(axis=0), points[:, 2].min()])
    ends = None if skeleton is None else (skeleton - origin) * scale
    return Seedling(name, (points - origin) * scale, colors, scale, ends, labels)


def _skeleton(file: Path) -> Array:
    """Read the ends (k, 2, 3) of the edges of a graph file with lines ``v x y z ...`` and ``e i j``."""
    lines = [line.split() for line in file.read_text().splitlines()]
    nodes = np.array([[float(x) for x in line[1:4]] for line in lines if line and line[0] == "v"])
    edges = np.array([[int(i) for i in line[1:3]] for line in lines if line and line[0] == "e"])
    return np.asarray(nodes[edges])
