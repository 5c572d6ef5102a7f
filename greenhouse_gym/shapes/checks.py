"""What a cloud must be before shapes are looked for in it, and what is said when it is not quite."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction.point_clouds import Cloud, exposure_failure, voxel_means
from greenhouse_gym.shapes.normals import estimate_normals
from greenhouse_gym.shapes.settings import ShapeSettings

_LONGEST, _HIGHEST = 200.0, 20.0  # metres of a row
_STRAY_CELL = 0.25  # metres that stray points are away from everything
_FAR = 4000  # so many of these lengths are told apart; what is farther off is in one place
_MOST_STRAYS = 0.01  # share of all points; more are no strays
_FEWEST = 50  # points that hold a shape
_NOTABLE = 0.01  # share of normals that are zero; fewer are where surfaces back to back share a cube


class ShapeWarning(UserWarning):
    """Something about a cloud, or about what was found in it, that a user should look at."""


@dataclass(frozen=True)
class Notes:
    """What was said about a cloud; each message is also raised as a `ShapeWarning`."""

    messages: list[str] = field(default_factory=list)

    def say(self, message: str) -> None:
        """Keep a message and warn of it."""
        self.messages.append(message)
        warnings.warn(message, ShapeWarning, stacklevel=3)


def checked(points: npt.ArrayLike, colors: npt.ArrayLike, normals: npt.ArrayLike | None) -> Cloud:
    """The arrays as a cloud; normals that are left out are zero.

    Raises:
        InvalidValueError: They do not fit together, hold NaN or colors beyond 1, or nearly all are black or white.
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
    if len(p) >= _FEWEST and (failure := exposure_failure(c)):
        raise InvalidValueError(f"colors: {failure}, but what is fruit, leaf or stem is told by color as well")
    return Cloud(p, c, n)


def thinned(whole: Cloud, with_normals: bool, settings: ShapeSettings, notes: Notes) -> Cloud:
    """A point and a normal for each voxel of a cloud that is large enough, without what strays.

    Normals that are missing or zero are estimated.

    Raises:
        InvalidValueError: The cloud is too large to be in metres.
    """
    if len(whole) < _FEWEST:
        notes.say(f"the cloud has {len(whole)} points, too few to hold a shape; expected at least {_FEWEST}")
        return whole.select(np.zeros(0, dtype=np.int64))
    stray = _stray(whole.points)
    if stray.any():
        notes.say(f"{np.count_nonzero(stray)} stray points, far from all others, were left out")
    cloud = whole.select(~stray)
    depth, height, length = np.sort(np.ptp(cloud.points, axis=0))
    if length > _LONGEST or height > _HIGHEST:
        raise InvalidValueError(
            f"the cloud is {length:.0f} by {height:.0f} by {depth:.0f} m, no row of plants; "
            "expected metres, not millimetres, and no stray points"
        )
    cloud, _ = voxel_means(cloud, settings.voxel)
    missing = np.linalg.norm(cloud.normals, axis=1) < 0.5
    if not missing.any():
        return cloud
    if with_normals and missing.mean() >= _NOTABLE:
        notes.say(f"the normals of {missing.mean():.0%} of the points are zero; they were estimated instead")
    return replace(cloud, normals=np.where(missing[:, None], estimate_normals(cloud.points, settings), cloud.normals))


def _stray(points: Array) -> npt.NDArray[np.bool_]:
    """Which points (n,) are few and far from all others."""
    cubes = np.clip(np.floor((points - np.median(points, axis=0)) / _STRAY_CELL), -_FAR, _FAR).astype(np.int64)
    cells, cell = np.unique((cubes + _FAR) @ [1, 4 * _FAR, 16 * _FAR**2], return_inverse=True)
    cells = np.stack([cells % (4 * _FAR), cells // (4 * _FAR) % (4 * _FAR), cells // (16 * _FAR**2)], axis=1)
    pairs = cKDTree(cells).query_pairs(1.8, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(cells),) * 2)
    part = connected_components(links, directed=False)[1][cell.ravel()]
    count = np.bincount(part)
    stray = np.asarray((count < _FEWEST)[part])
    return stray if stray.mean() < _MOST_STRAYS else np.zeros(len(points), dtype=bool)
