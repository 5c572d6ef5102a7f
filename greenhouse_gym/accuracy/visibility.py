"""How much of each object of a row a recording could show: shares of the pixels that the object alone would cover."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.raycast import RowRaycaster
from greenhouse_gym.capture.rig import Camera, Intrinsics, Rig
from greenhouse_gym.crop import Stem
from greenhouse_gym.geometry import Array, Capsule, Shape, Sphere, invert, transform
from greenhouse_gym.plants import PlantRow

VISIBLE = 0.30
"""Share of its own pixels from which on an object counts as visible."""

FOREGROUND = 0.60
"""Metres in front of the reference camera, along the rig's forward axis, beyond which nothing counts as seen."""


class Visibility(NamedTuple):
    """How much of each object was seen in the frame that shows most of it.

    Attributes:
        in_image: (n,) share of the pixels that the object alone would cover in the image: what hides it are other
            objects and the foreground cut. This decides whether an object counts as visible.
        whole: (n,) the same as a share of the object's whole silhouette: what the edge of the image cuts off counts as
            hidden too. This says how much there is to see.
    """

    in_image: Array
    whole: Array

    @property
    def visible(self) -> npt.NDArray[np.bool_]:
        """Which objects (n,) count as visible."""
        return self.in_image >= VISIBLE


class StemPieces(NamedTuple):
    """Stems cut into short pieces, so that the hidden part of a stem is not taken for a visible one.

    Attributes:
        pieces: The pieces.
        owner: (n,) index of the stem each was cut from.
    """

    pieces: tuple[Stem, ...]
    owner: npt.NDArray[np.int64]


def cut_stems(stems: Sequence[Stem], longest: float = 0.02) -> StemPieces:
    """Cut stems into equal pieces of at most ``longest`` metres."""
    pieces: list[Stem] = []
    owner: list[int] = []
    for index, stem in enumerate(stems):
        ends = np.linspace(stem.start, stem.end, max(1, int(np.ceil(stem.length / longest - 1e-9))) + 1)
        pieces += [Stem(a, b, stem.radius, stem.kind) for a, b in pairwise(ends)]
        owner += [index] * (len(ends) - 1)
    return StemPieces(tuple(pieces), np.array(owner, dtype=np.int64))


def tomato_visibility(row: PlantRow, rig: Rig, world_from_station: Array) -> Visibility:
    """Visibility of a row's tomatoes to a rig at true poses (stations, 4, 4)."""
    return visibility(row, row.tomatoes, np.arange(len(row.tomatoes)), rig, world_from_station)


def stem_visibility(row: PlantRow, cut: StemPieces, rig: Rig, world_from_station: Array) -> Visibility:
    """Visibility of pieces of a row's stems to a rig at true poses (stations, 4, 4)."""
    return visibility(row, cut.pieces, len(row.tomatoes) + cut.owner, rig, world_from_station)


def visible_tomatoes(row: PlantRow, rig: Rig, world_from_station: Array) -> npt.NDArray[np.bool_]:
    """Which tomatoes (n,) of a row a recording could show at all, the rig standing at true poses (stations, 4, 4)."""
    return tomato_visibility(row, rig, world_from_station).visible


def visibility(
    row: PlantRow,
    objects: Sequence[Shape],
    shape: npt.NDArray[np.int64],
    rig: Rig,
    world_from_station: Array,
    foreground: float = FOREGROUND,
) -> Visibility:
    """The share of the pixels an object alone would cover that show it, in the frame where it is largest.

    Args:
        row: The grown row.
        objects: Spheres and capsules of the row, or parts of them.
        shape: (n,) number of the row's shape that each object is or belongs to, as `RowRaycaster` counts them.
        rig: The cameras.
        world_from_station: (stations, 4, 4) true poses.
        foreground: What lies beyond this many metres in front of the reference camera, along the rig's forward axis,
            is not seen.
    """
    caster = RowRaycaster.of(row)
    front = rig.cameras[rig.reference].rig_from_camera[0, 3] + foreground
    axes = np.array([_ends(item) for item in objects]).reshape(-1, 2, 3)
    radii = np.array([_radius(item) for item in objects])
    best = Visibility(np.zeros(len(objects)), np.zeros(len(objects)))
    for pose in world_from_station:
        for camera in rig.cameras.values():
            world_from_camera = pose @ camera.rig_from_camera
            depth, seen = caster.measure(world_from_camera, camera.intrinsics)
            seen[_beyond(depth, camera, front)] = -1
            ends = transform(invert(world_from_camera), axes.reshape(-1, 3)).reshape(-1, 2, 3)
            for i in _in_view(ends, radii, camera.intrinsics, 2 * foreground):
                window, alone = _silhouette(ends[i], float(radii[i]), camera.intrinsics)
                inside, part = _clipped(window, camera.intrinsics)
                covered = alone[part]
                count = np.count_nonzero(covered)
                if count:
                    shown = np.count_nonzero(covered & (seen[inside] == shape[i]))
                    best.in_image[i] = max(best.in_image[i], shown / count)
                    best.whole[i] = max(best.whole[i], shown / np.count_nonzero(alone))
    return best


def _ends(item: Shape) -> list[Array]:
    return [item.start, item.end] if isinstance(item, Capsule) else [item.center, item.center]


def _radius(item: Shape) -> float:
    assert isinstance(item, (Sphere, Capsule)), "only spheres and capsules have silhouettes here"
    return item.radius


def _beyond(depth: npt.NDArray[np.float32], camera: Camera, front: float) -> npt.NDArray[np.bool_]:
    """Pixels (h, w) whose points lie beyond ``front`` in the rig frame, or that show nothing."""
    k, turn = camera.intrinsics, camera.rig_from_camera
    x = (np.arange(k.width) - k.cx)[None, :] / k.fx
    y = (np.arange(k.height) - k.cy)[:, None] / k.fy
    forward = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2]
    with np.errstate(invalid="ignore"):
        return ~(depth * forward + turn[0, 3] < front)


def _in_view(ends: Array, radii: Array, k: Intrinsics, farthest: float) -> npt.NDArray[np.int64]:
    """Which capsules (n,), axes (n, 2, 3) in the camera frame, may show on an image; none that reach to the camera."""
    z = ends[..., 2]
    ahead = (z.min(axis=1) > 2 * radii) & (z.min(axis=1) < farthest)
    safe = np.maximum(z, 1e-6)
    margin = 1.3 * radii[:, None] * max(k.fx, k.fy) / np.maximum(safe - radii[:, None], 1e-6) + 1.0
    u, v = k.fx * ends[..., 0] / safe + k.cx, k.fy * ends[..., 1] / safe + k.cy
    across = ((u + margin).max(axis=1) > 0) & ((u - margin).min(axis=1) < k.width)
    down = ((v + margin).max(axis=1) > 0) & ((v - margin).min(axis=1) < k.height)
    return np.flatnonzero(ahead & across & down)


def _silhouette(ends: Array, radius: float, k: Intrinsics) -> tuple[tuple[range, range], npt.NDArray[np.bool_]]:
    """Rows and columns that a capsule may cover, within the image or not, and which of these pixels it covers."""
    margin = 1.3 * radius * max(k.fx, k.fy) / (ends[:, 2] - radius) + 1.0
    u, v = k.fx * ends[:, 0] / ends[:, 2] + k.cx, k.fy * ends[:, 1] / ends[:, 2] + k.cy
    columns = range(int(np.floor((u - margin).min())), int(np.ceil((u + margin).max())) + 1)
    rows = range(int(np.floor((v - margin).min())), int(np.ceil((v + margin).max())) + 1)
    x, y = np.meshgrid((np.array(columns) - k.cx) / k.fx, (np.array(rows) - k.cy) / k.fy)
    return (rows, columns), _rays_meet(x, y, ends, radius)


def _rays_meet(x: Array, y: Array, ends: Array, radius: float) -> npt.NDArray[np.bool_]:
    """Whether the rays from the origin along (x, y, 1) come within ``radius`` of the segment between two ends (2, 3).

    The distance from a point of the segment to a ray's line is least where it is the common perpendicular of both
    lines, or at an end.
    """
    squared = x * x + y * y + 1.0
    start, along = ends[0], ends[1] - ends[0]

    def dot(a: Array, b: Array) -> Array:
        return np.asarray(a @ b)

    ray_start = x * start[0] + y * start[1] + start[2]
    ray_along = x * along[0] + y * along[1] + along[2]
    # minimise |s + t a|^2 - ((s + t a) . d)^2 / d^2 over 0 <= t <= 1
    quadratic = dot(along, along) - ray_along**2 / squared
    linear = dot(start, along) - ray_start * ray_along / squared
    t = np.clip(np.where(quadratic > 1e-12, -linear / np.maximum(quadratic, 1e-12), 0.0), 0.0, 1.0)
    distance = dot(start, start) - ray_start**2 / squared + t * (2 * linear + t * quadratic)
    return np.asarray(distance < radius**2)


def _clipped(window: tuple[range, range], k: Intrinsics) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """The part of a window of pixels that lies in the image: as slices of the image, and as slices of the window."""
    inside, part = [], []
    for span, size in zip(window, (k.height, k.width), strict=True):
        low, high = min(max(span.start, 0), size), min(max(span.stop, 0), size)
        inside.append(slice(low, high))
        part.append(slice(low - span.start, high - span.start))
    return (inside[0], inside[1]), (part[0], part[1])
