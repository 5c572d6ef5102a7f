"""One way from a cloud to shapes: tomatoes first, then stems, and boxes for what is left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greenhouse_gym.crop import Stem, Tomato
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, Box, distance_to_shapes
from greenhouse_gym.reconstruction.clouds import Cloud, to_open3d, voxel_means
from greenhouse_gym.shapes.clutter import cover
from greenhouse_gym.shapes.colors import could_be_fruit_or_stem
from greenhouse_gym.shapes.peduncles import find_peduncles
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.stems import find_main_stems
from greenhouse_gym.shapes.tomatoes import find_tomatoes


@dataclass(frozen=True, eq=False)
class RowShapes:
    """What a cloud was found to hold, in the cloud's frame (metres).

    Attributes:
        tomatoes: Fruits with truss and ripeness.
        stems: Main stems, peduncles and pedicels.
        clutter: Boxes around everything else.
    """

    tomatoes: tuple[Tomato, ...] = ()
    stems: tuple[Stem, ...] = ()
    clutter: tuple[Box, ...] = ()


def extract_shapes(
    points: npt.ArrayLike,
    colors: npt.ArrayLike,
    normals: npt.ArrayLike | None = None,
    settings: ShapeSettings | None = None,
) -> RowShapes:
    """Find tomatoes, stems and clutter in a cloud.

    Args:
        points: (n, 3) metres; z up.
        colors: (n, 3) RGB in [0, 1].
        normals: (n, 3) unit vectors out of the surfaces; estimated, and turned against x, when left out.
        settings: All settings.

    Returns:
        The shapes; empty where the cloud holds too little.

    Raises:
        InvalidValueError: The arrays do not fit together, hold NaN, or the cloud is too large to be in metres.
    """
    settings = settings or ShapeSettings()
    cloud = _checked(points, colors, normals)
    if len(cloud) < 50:
        return RowShapes()
    cloud, _ = voxel_means(cloud, settings.voxel)
    tomatoes = find_tomatoes(cloud.points, cloud.normals, cloud.colors, settings).tomatoes
    cloud = _without(cloud, list(tomatoes), settings.shell)
    woody = cloud.select(could_be_fruit_or_stem(cloud.colors, settings))
    main = find_main_stems(woody.points, woody.normals, settings)
    woody = _without(woody, main, settings.shell)
    thin = find_peduncles(woody.points, woody.normals, tomatoes, main, settings)
    cloud = _without(cloud, [*main, *thin], settings.shell)
    budget = round(settings.clutter_per_metre * float(np.ptp(cloud.points[:, 1]))) if len(cloud) else 0
    return RowShapes(tomatoes, (*main, *thin), tuple(cover(cloud.points, cloud.normals, max(budget, 10), settings)))


def _checked(points: npt.ArrayLike, colors: npt.ArrayLike, normals: npt.ArrayLike | None) -> Cloud:
    p, c = np.asarray(points, dtype=np.float64), np.asarray(colors, dtype=np.float64)
    n = None if normals is None else np.asarray(normals, dtype=np.float64)
    for name, array in (("points", p), ("colors", c), ("normals", n)):
        if array is None:
            continue
        if array.ndim != 2 or array.shape != (len(p), 3):
            raise InvalidValueError(f"{name} must be of shape ({len(p)}, 3), got {array.shape}")
        if not np.isfinite(array).all():
            raise InvalidValueError(f"{name} must be finite, {(~np.isfinite(array)).any(axis=1).sum()} rows are not")
    depth, height, length = np.sort(np.ptp(p, axis=0)) if len(p) else np.zeros(3)
    if length > 200.0 or height > 20.0:
        raise InvalidValueError(
            f"the cloud is {length:.0f} by {height:.0f} by {depth:.0f} m, no row of plants; "
            "expected metres, not millimetres, and no stray points"
        )
    if n is None:
        n = _estimated_normals(p)
    return Cloud(p, c, n)


def _estimated_normals(points: Array) -> Array:
    if len(points) < 3:
        return np.tile([-1.0, 0.0, 0.0], (len(points), 1))
    from greenhouse_gym.open3d_loader import open3d

    cloud = to_open3d(Cloud(points, np.zeros_like(points), np.zeros_like(points)))
    cloud.estimate_normals(open3d().geometry.KDTreeSearchParamKNN(16))
    cloud.orient_normals_to_align_with_direction([-1.0, 0.0, 0.0])
    return np.array(cloud.normals)


def _without(cloud: Cloud, shapes: list[Tomato] | list[Stem], margin: float) -> Cloud:
    """The points farther than ``margin`` metres outside all of the shapes."""
    outside = np.ones(len(cloud), dtype=bool)
    for shape in shapes:  # most shapes are far from most points: look only at a box around each
        low, high = _bounds(shape, margin)
        rows = np.flatnonzero(outside & (cloud.points >= low).all(axis=1) & (cloud.points <= high).all(axis=1))
        outside[rows[distance_to_shapes(cloud.points[rows], [shape])[:, 0] < margin]] = False
    return cloud.select(outside)


def _bounds(shape: Tomato | Stem, margin: float) -> tuple[Array, Array]:
    ends = np.array([shape.center, shape.center] if isinstance(shape, Tomato) else [shape.start, shape.end])
    grow = shape.radius + margin
    return ends.min(axis=0) - grow, ends.max(axis=0) + grow
