"""A real RGB-D frame of an apple tree: read it, compare extracted fruit with its labels, and draw both.

The frame is of an Azure Kinect at 1.3 m. Its labels are boxes around apples, with the diameters that a caliper gave;
two of them are white balls, which are no fruit and are left out.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture import Intrinsics
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.point_clouds import Cloud
from greenhouse_gym.reconstruction.station_views import image_normals
from greenhouse_gym.shapes import RowShapes
from greenhouse_gym.shapes.surface_cloud import redness

CAMERA = Intrinsics(1920, 1080, 917.123, 916.965, 957.721, 550.789)

_WORLD_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_RED = 0.1  # redness of the median pixel on a fruit, above which it is red skin
_RIGHT_SIZE = 0.2  # largest relative error of a diameter that counts as right
_CONFIDENT = 0.8


class Label(NamedTuple):
    """A labeled apple: the corners of its box in pixels, and the mean of two caliper diameters, m."""

    low: Array
    high: Array
    diameter: float


class OrchardFrame(NamedTuple):
    """The frame: image (h, w, 3) RGB in [0, 1], depth (h, w) in m, its cloud with z up, and its labels."""

    image: Array
    depth: npt.NDArray[np.float32]
    cloud: Cloud
    labels: list[Label]


def read_orchard(folder: Path) -> OrchardFrame:
    """Read the frame in ``orchard_azure_kinect``; normals are those of the depth image."""
    here = Path(folder) / "orchard_azure_kinect"
    image = np.asarray(cv2.imread(str(here / "color.jpg")))[..., ::-1] / 255.0
    depth = np.asarray(cv2.imread(str(here / "depth.png"), cv2.IMREAD_UNCHANGED)).astype(np.float32) / 1000
    v, u = np.nonzero(depth)
    rays = np.column_stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))])
    points = rays * depth[v, u].astype(np.float64)[:, None]
    normals = image_normals(depth, depth > 0, CAMERA)
    cloud = Cloud(points @ _WORLD_FROM_CAMERA.T, image[v, u], normals @ _WORLD_FROM_CAMERA.T)
    with (here / "apples.csv").open() as file:
        labels = [_label(row) for row in csv.DictReader(file) if not row["name"].startswith("BALL")]
    return OrchardFrame(image, depth, cloud, labels)


def measure_orchard(frame: OrchardFrame, shapes: RowShapes) -> dict[str, Any]:
    """Compare the fruit found in the frame with its labels and with the color of its pixels."""
    fruit, labels = shapes.tomatoes, frame.labels
    inside = np.array([in_box(tomato, labels) for tomato in fruit]).reshape(-1, len(labels))
    errors = [
        min(abs(2 * fruit[k].radius / label.diameter - 1) for k in np.flatnonzero(inside[:, i]))
        for i, label in enumerate(labels)
        if inside[:, i].any()
    ]
    red = np.array([median_redness(tomato, frame) > _RED for tomato in fruit], dtype=bool)
    true = (red | inside.any(axis=1))[np.array(shapes.confidence) >= _CONFIDENT]
    return {
        "labels": len(labels),
        "hit": len(errors),
        "right_size": sum(error < _RIGHT_SIZE for error in errors),
        "spheres": len(fruit),
        "red": float(red.mean()) if len(fruit) else float("nan"),
        "confident": len(true),
        "confident_true": float(true.mean()) if len(true) else float("nan"),
        "warnings": list(shapes.warnings),
    }


def draw_orchard(frame: OrchardFrame, runs: Sequence[RowShapes], file: Path) -> None:
    """Draw the fruit of each run over a copy of the image, from left to right; blue in a label's box."""
    pictures = []
    for shapes in runs:
        picture = (255 * frame.image[..., ::-1]).astype(np.uint8)
        for label in frame.labels:
            cv2.rectangle(picture, label.low.astype(int).tolist(), label.high.astype(int).tolist(), (255, 255, 255), 1)
        for tomato in shapes.tomatoes:
            pixel, radius = project(tomato)
            color = (255, 0, 0) if in_box(tomato, frame.labels).any() else (0, 255, 255)
            cv2.circle(picture, pixel.astype(int).tolist(), max(int(radius), 2), color, 2)
        pictures.append(picture)
    cv2.imwrite(str(file), np.hstack(pictures))


def project(tomato: Tomato) -> tuple[Array, float]:
    """Return the pixel (2,) of a fruit's center and its radius in pixels."""
    x, y, z = _WORLD_FROM_CAMERA.T @ tomato.center
    return np.array([CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy]), CAMERA.fx * tomato.radius / z


def in_box(tomato: Tomato, labels: Sequence[Label]) -> npt.NDArray[np.bool_]:
    """Return for each label (k,) whether the fruit's center lies in its box."""
    pixel = project(tomato)[0]
    inside = [bool((label.low <= pixel).all() and (pixel <= label.high).all()) for label in labels]
    return np.array(inside, dtype=np.bool_)


def median_redness(tomato: Tomato, frame: OrchardFrame) -> float:
    """Return the median redness of the fruit's pixels at its depth, or -1 without any."""
    pixel, radius = project(tomato)
    rows, columns = (np.arange(max(int(c - radius), 0), int(c + radius) + 2) for c in pixel[::-1])
    rows, columns = rows[rows < frame.depth.shape[0]], columns[columns < frame.depth.shape[1]]
    window = np.ix_(rows, columns)
    near = np.hypot(rows[:, None] - pixel[1], columns[None] - pixel[0]) < 0.9 * radius
    front = float(tomato.center[0]) - 0.6 * tomato.radius
    near &= (frame.depth[window] > 0) & (np.abs(frame.depth[window] - front) < max(tomato.radius, 0.015))
    return float(np.median(redness(frame.image[window][near]))) if near.any() else -1.0


def _label(row: dict[str, str]) -> Label:
    low, high = (np.array([float(row[f"{axis}_{end}"]) for axis in "xy"]) for end in ("min", "max"))
    return Label(low, high, (float(row["caliper_1_mm"]) + float(row["caliper_2_mm"])) / 2000)
