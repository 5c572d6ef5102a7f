"""Checks and cleaning of a cloud before shapes are extracted, and the resulting warnings.

The last check compares a cloud with those to which the networks were fitted; elsewhere their scores mean nothing.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.point_clouds import Cloud, exposure_failure, group_sizes, voxel_means
from greenhouse_gym.shapes.neighborhoods import estimate_normals
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.surface_cloud import NO_LEAF, SurfaceCloud

_MAX_LENGTH, _MAX_HEIGHT = 200.0, 20.0  # metres of a row
_OUTLIER_CELL = 0.25  # metres that outliers are away from everything else
_MAX_OUTLIERS = 0.01  # fraction of all points; more are no outliers
_MIN_POINTS = 50  # points needed to extract a shape
_MAX_ZERO_NORMALS = 0.01  # fraction; fewer occur where surfaces back to back fall into one voxel

_MIN_COHERENCE, _MIN_LEAFLESS_COHERENCE = 0.85, 0.93
"""Least `SurfaceCloud.coherence` with and without leaves whose color is known.

Thirds of the rows that the networks were fitted to have 0.90 to 0.98, whole ones 0.94 to 0.99; a real frame of an apple
tree, whose flat surfaces have the colors of bark, sky and leaves, has 0.89.
"""

_MAX_HUE_SPREAD = 0.05
"""Largest `SurfaceCloud.leaf_hue_spread` of leaves; rows that the networks were fitted to have 0.01 to 0.04."""

_MAX_NOISE = 0.0026
"""Largest `SurfaceCloud.noise`, m. Rows that the networks were fitted to have 0.0013 to 0.0017; rows recorded from
0.8 m, where the networks work as well, have 0.0017 to 0.0022."""

_MIN_DENSITY = 10.0
"""Least `SurfaceCloud.density`; rows that the networks were fitted to have 20 to 24."""

_MIN_DOMAIN_POINTS = 20_000
"""Points below which a cloud is too small to be judged: the normals of a single fruit vary as much as noisy ones."""


class ShapeWarning(UserWarning):
    """A problem with a cloud, or with the shapes extracted from it, that a user should check."""


@dataclass(frozen=True)
class WarningLog:
    """Warnings about a cloud; each is also raised as a `ShapeWarning`."""

    messages: list[str] = field(default_factory=list)

    def warn(self, message: str) -> None:
        """Record a message and raise it as a warning."""
        self.messages.append(message)
        warnings.warn(message, ShapeWarning, stacklevel=3)


def validated_cloud(points: npt.ArrayLike, colors: npt.ArrayLike, normals: npt.ArrayLike | None) -> Cloud:
    """Return the arrays as a cloud; normals that are left out become zero.

    Raises:
        InvalidValueError: The arrays differ in shape, hold NaN or colors above 1, or nearly all colors are black or
            white.
    """
    p, c = np.asarray(points, dtype=np.float64), np.asarray(colors, dtype=np.float64)
    n = np.zeros_like(p) if normals is None else np.asarray(normals, dtype=np.float64)
    for name, array in (("points", p), ("colors", c), ("normals", n)):
        if array.ndim != 2 or array.shape != (len(p), 3):
            raise InvalidValueError(f"{name} must be of shape ({len(p)}, 3), got {array.shape}")
        if not np.isfinite(array).all():
            raise InvalidValueError(f"{name} must be finite, {(~np.isfinite(array)).any(axis=1).sum()} rows are not")
    if c.min(initial=0.0) < 0.0 or c.max(initial=0.0) > 1.0:
        raise InvalidValueError(f"colors must be between 0 and 1, got {c.min():g} to {c.max():g}")
    if len(p) >= _MIN_POINTS and (failure := exposure_failure(c)):
        raise InvalidValueError(f"colors: {failure}, but fruit, leaves and stems are distinguished by color")
    return Cloud(p, c, n)


def downsample(whole: Cloud, with_normals: bool, settings: ShapeSettings, log: WarningLog) -> Cloud:
    """Reduce a cloud to one point and normal per voxel, without outliers; empty if it has too few points.

    Normals that are missing or zero are estimated.

    Raises:
        InvalidValueError: The cloud is too large to be in metres.
    """
    if len(whole) < _MIN_POINTS:
        log.warn(f"the cloud has {len(whole)} points, too few to hold a shape; expected at least {_MIN_POINTS}")
        return whole.select(np.zeros(0, dtype=np.int64))
    outlier = _outlier_mask(whole.points)
    if outlier.any():
        log.warn(f"{np.count_nonzero(outlier)} outliers, far from all other points, were ignored")
    cloud = whole.select(~outlier)
    depth, height, length = np.sort(np.ptp(cloud.points, axis=0))
    if length > _MAX_LENGTH or height > _MAX_HEIGHT:
        raise InvalidValueError(
            f"the cloud measures {length:.4g} by {height:.4g} by {depth:.4g} m, too large for a row of plants; "
            "expected metres, not millimetres, and no outliers"
        )
    cloud, _ = voxel_means(cloud, settings.voxel)
    missing = np.linalg.norm(cloud.normals, axis=1) < 0.5
    if not missing.any():
        return cloud
    if with_normals and missing.mean() >= _MAX_ZERO_NORMALS:
        log.warn(f"the normals of {missing.mean():.0%} of the points are zero; they were estimated instead")
    return replace(cloud, normals=np.where(missing[:, None], estimate_normals(cloud.points), cloud.normals))


def _outlier_mask(points: Array) -> npt.NDArray[np.bool_]:
    """Return which points (n,) form small groups far from all others."""
    outlier = group_sizes(points, _OUTLIER_CELL) < _MIN_POINTS
    return outlier if outlier.mean() < _MAX_OUTLIERS else np.zeros(len(points), dtype=bool)


def outside_domain(surface: SurfaceCloud) -> str:
    """Return a phrase on the property in which a cloud differs from those the networks were fitted to, or ""."""
    if len(surface) < _MIN_DOMAIN_POINTS:
        return ""
    leafless = surface.leaf_hue == NO_LEAF or surface.leaf_hue_spread > _MAX_HUE_SPREAD
    if surface.coherence < (_MIN_LEAFLESS_COHERENCE if leafless else _MIN_COHERENCE):
        color = ", and its flat surfaces do not have the color of leaves" if leafless else ""
        return f"its normals vary too much within a centimetre (mean length {surface.coherence:.2f}, not 0.94){color}"
    if surface.noise > _MAX_NOISE:
        return f"its points scatter by {1e3 * surface.noise:.1f} mm about its surfaces, not by 1.3 to 2.2 mm"
    if surface.density < _MIN_DENSITY:
        return f"its points are too sparse (about {surface.density:.0f} patches of 5 mm within 11 mm, not 20 or more)"
    return ""
