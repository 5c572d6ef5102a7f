"""Pictures of recordings, reconstructions, shapes and occupancy; clouds are splatted and meshes ray-cast."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.accuracy.silhouettes import Outlines
from greenhouse_gym.capture import Recording
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, Ellipsoid, Shape, Sphere, invert, pose, transform
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, TriangleMesh
from greenhouse_gym.reconstruction.foreground import Shift, along, black_out, overlapping_parts
from greenhouse_gym.reconstruction.occupancy_carving import carve
from greenhouse_gym.reconstruction.pair_registration import register_pair
from greenhouse_gym.reconstruction.station_views import Calibration, CameraView, station_view
from greenhouse_gym.rendering.picture_files import write_picture
from greenhouse_gym.rendering.renderer import Image
from greenhouse_gym.scene.occupancy import UNKNOWN
from greenhouse_gym.shapes import RowShapes

_VIEW = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""View from the aisle by rows: image right is -y, image up is z, and x points away."""

RED, BLUE = (0.85, 0.15, 0.12), (0.12, 0.25, 0.85)
_TOMATO, _STEM, _CLUTTER = (230, 30, 30), (20, 60, 255), (250, 200, 40)  # RGB of outlines

_SHEET_STATIONS, _SHEET_HEIGHT = 6, 180  # px of an image
_FARTHEST = 1.5  # m, drawn darkest
_GAP = 12  # px between images


def upright(image: Image) -> Image:
    """Turn a portrait camera's image upright."""
    return np.ascontiguousarray(np.rot90(image, -1))


def side_by_side(images: Sequence[Image]) -> Image:
    """Put images next to each other on white, padded to the same height."""
    tallest = max(image.shape[0] for image in images)
    padded = [np.pad(i, ((0, tallest - len(i)), (0, _GAP), (0, 0)), constant_values=255) for i in images]
    return np.concatenate(padded, axis=1)[:, :-_GAP]


def save_pipeline(photograph: Image, cloud: Image, scene: Image, path: Path, height: int = 480) -> Path:
    """Draw the steps of the data as one picture: a photograph, the row's cloud, the arm in the scene."""
    import cv2

    parts = [
        cv2.resize(image, (image.shape[1] * height // image.shape[0], height), interpolation=cv2.INTER_AREA)
        for image in (photograph, cloud, scene)
    ]
    return write_picture(side_by_side([np.asarray(part, dtype=np.uint8) for part in parts]), path)


def contact_sheet(recording: Recording) -> Image:
    """Return up to six stations spread over a recording, seen by the reference camera: color above depth."""
    import cv2

    columns = []
    for i in np.unique(np.linspace(0, len(recording) - 1, _SHEET_STATIONS).round().astype(int)).tolist():
        try:
            frame = recording.frame(i, recording.rig.reference)
        except FileFormatError:
            continue
        brightness = 1.0 - np.clip(frame.depth / _FARTHEST, 0.0, 0.9)
        depth = np.where(frame.depth > 0, 255 * brightness, 0).astype(np.uint8)
        width = round(_SHEET_HEIGHT * frame.color.shape[1] / frame.color.shape[0])
        both = (frame.color, np.repeat(depth[..., None], 3, axis=2))
        columns.append(np.concatenate([cv2.resize(image, (width, _SHEET_HEIGHT)) for image in both]))
    return np.concatenate(columns, axis=1) if columns else np.zeros((2 * _SHEET_HEIGHT, _SHEET_HEIGHT, 3), np.uint8)


def splat(points: Array, colors: Array, width: int = 1400, size: int = 2) -> Image:
    """Draw points (n, 3) with colors (n, 3) in [0, 1] orthographically on white, near ones over far ones.

    Args:
        points: Metres.
        colors: RGB.
        width: Pixels.
        size: Pixels along the side of a point.
    """
    right, up, away = _VIEW @ points.T
    scale = (width - 20) / max(float(np.ptp(right)), 1e-6)
    height = int(np.ptp(up) * scale) + 20
    image = np.full((height + size, width + size, 3), 255, dtype=np.uint8)
    columns = ((right - right.min()) * scale).astype(int) + 10
    rows = height - 10 - ((up - up.min()) * scale).astype(int)
    order = np.argsort(-away, kind="stable")
    ink = (np.clip(colors[order], 0, 1) * 255).astype(np.uint8)
    for dy in range(size):
        for dx in range(size):
            image[rows[order] + dy, columns[order] + dx] = ink
    return image[:height, :width]


def draw_mesh(mesh: TriangleMesh, width: int = 1400) -> Image:
    """Draw a mesh orthographically, shaded by the normals of its faces."""
    o3d = open3d()
    scene: Any = o3d.t.geometry.RaycastingScene()
    vertices = mesh.vertices @ _VIEW.T
    scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(mesh.triangles.astype(np.uint32)))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    step = (high[0] - low[0]) / width
    x, y = np.meshgrid(np.arange(low[0], high[0], step), np.arange(high[1], low[1], -step))
    rays = np.zeros((*x.shape, 6), dtype=np.float32)
    rays[..., 0], rays[..., 1], rays[..., 2], rays[..., 5] = x, y, low[2] - 1.0, 1.0
    hits = scene.cast_rays(o3d.core.Tensor(rays))
    normals = hits["primitive_normals"].numpy()
    light = np.abs(normals @ (np.array([0.3, 0.5, -0.81]) / np.linalg.norm([0.3, 0.5, -0.81])))
    shade = np.where(np.isfinite(hits["t_hit"].numpy()), 0.25 + 0.7 * light, 1.0)
    return (np.repeat(shade[..., None], 3, axis=2) * 255).astype(np.uint8)


def registration_pictures(
    recording: Recording,
    first: int,
    second: int,
    calibration: Calibration,
    settings: ReconstructionSettings,
    out: Path,
) -> list[Path]:
    """Draw two neighboring stations: images, foreground, silhouettes at the best shift, clouds before and after ICP."""
    one, two = (station_view(recording[i], calibration, settings) for i in (first, second))
    views = (one.reference, two.reference)
    paths = [
        write_picture(side_by_side([upright(view.color) for view in views]), out / "1-two-images.png"),
        write_picture(
            side_by_side([upright(black_out(view.color, view.foreground)) for view in views]),
            out / "2-foreground.png",
        ),
    ]
    found = register_pair(one, two, second - first, settings)
    if found.shift is None or found.offset is None:
        return paths
    overlay = shifted_silhouettes(*views, found.shift)
    paths.append(write_picture(upright(overlay), out / "3-silhouettes-at-best-shift.png"))
    here, there = (view.packed_cloud().transformed(np.eye(4)) for view in (one, two))
    pictures = []
    for first_from_second in (pose(translation=found.offset), found.first_from_second):
        everything = np.concatenate([here.points, transform(first_from_second, there.points)])
        colors = np.concatenate([np.tile(RED, (len(here), 1)), np.tile(BLUE, (len(there), 1))])
        pictures.append(splat(everything, colors, width=700, size=1))
    paths.append(write_picture(side_by_side(pictures), out / "4-before-and-after-icp.png"))
    return paths


def shifted_silhouettes(first: CameraView, second: CameraView, shift: Shift) -> Image:
    """Draw two silhouettes over each other after a shift: the first red, the second blue, both purple."""
    a, b = overlapping_parts(first.depth, shift.pixels, shift.axis)
    one, two = first.foreground[along(shift.axis, a)], second.foreground[along(shift.axis, b)]
    image = np.full((*one.shape, 3), 255, dtype=np.uint8)
    image[one & ~two] = (220, 50, 40)
    image[two & ~one] = (40, 70, 220)
    image[one & two] = (140, 60, 160)
    return image


def row_pictures(merged: RowCloud, row: RowCloud, mesh: TriangleMesh, out: Path) -> list[Path]:
    """Draw a row in one color per station before and after outlier removal, in its own colors, and as a mesh."""
    count = len(row.registered)
    hue = np.random.default_rng(3).permutation(count) / count
    wheel = 0.5 + 0.45 * np.cos(2 * np.pi * (hue[:, None] + [0.0, 1 / 3, 2 / 3]))
    return [
        write_picture(splat(merged.points, wheel[merged.station]), out / "5-stations-before-outlier-removal.png"),
        write_picture(splat(row.points, wheel[row.station]), out / "6-stations-after-outlier-removal.png"),
        write_picture(splat(row.points, row.colors), out / "7-row.png"),
        write_picture(draw_mesh(mesh), out / "8-mesh.png"),
    ]


def occupancy_picture(row: RowCloud, out: Path) -> tuple[Path, float]:
    """Draw the occupancy of the scanned space in two upright planes.

    Left, across the row in the middle of the walk, with the aisle on the left; right, along the row halfway between
    cameras and plants. White is free, green is occupied, gray is unknown.

    Returns:
        The PNG file, and the observed fraction of the space within an arm's reach.
    """
    positions = row.world_from_station[row.registered][:, :3, 3]
    middle = np.median(positions, axis=0)
    reach = np.array([1.35, 1.35, 0.0])
    low, high = positions.min(axis=0) - reach, positions.max(axis=0) + reach
    low[2], high[2] = 0.0, 2.4
    carving = carve(row, np.eye(4), low, high)
    cells = ((middle + [0.25, 0.0, 0.0] - carving.origin) / carving.voxel).astype(int)
    palette = np.array([[150, 152, 158], [250, 251, 252], [58, 125, 68]], dtype=np.uint8)  # unknown, free, occupied
    planes = (carving.states[:, cells[1]], carving.states[cells[0]])
    images = [np.kron(palette[plane.T[::-1]], np.ones((8, 8, 1), dtype=np.uint8)) for plane in planes]
    centers = np.moveaxis(np.indices(carving.states.shape), 0, -1) * carving.voxel + carving.origin
    near = np.linalg.norm(centers - [middle[0], middle[1], 1.1], axis=-1) < reach[0]
    observed = float((carving.states[near] != UNKNOWN).mean())
    return write_picture(side_by_side(images), out / "9-occupancy.png"), observed


def draw_outlines(
    photograph: Image, shapes: Sequence[Shape], intrinsics: Intrinsics, camera_from_shapes: Array
) -> Image:
    """Draw the outlines of shapes over a photograph (h, w, 3): tomatoes red, stems blue, the rest yellow.

    Args:
        photograph: The camera's image; not changed.
        shapes: Shapes in any frame.
        intrinsics: Intrinsics of the camera.
        camera_from_shapes: (4, 4) pose of the shapes' frame.
    """
    import cv2

    image = photograph.copy()
    outlines = Outlines.of(shapes).seen_from(camera_from_shapes)
    for i in outlines.in_view(intrinsics, np.inf, np.ones(len(shapes), dtype=bool)).tolist():
        mask = np.zeros(image.shape[:2], dtype=np.uint8)
        alone = outlines.silhouette(i, intrinsics)
        mask[alone.image] = alone.covered
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        is_fruit, is_stem = isinstance(shapes[i], Sphere | Ellipsoid), isinstance(shapes[i], Stem)
        color = _TOMATO if is_fruit else _STEM if is_stem else _CLUTTER
        cv2.drawContours(image, contours, -1, color, 2 if is_fruit else 1)
    return image


def shapes_over_photograph(recording: Recording, row: RowCloud, found: RowShapes, station: int) -> Image:
    """Draw a row's shapes over the reference camera's photograph at a registered station, clutter below the rest."""
    camera = recording.rig.cameras[recording.rig.reference]
    photograph = recording[station].frames[recording.rig.reference].color
    camera_from_row = invert(row.world_from_station[station] @ camera.rig_from_camera)
    ordered: list[Shape] = [*found.clutter, *found.stems, *(tomato.shape for tomato in found.tomatoes)]
    return draw_outlines(photograph, ordered, camera.intrinsics, camera_from_row)
