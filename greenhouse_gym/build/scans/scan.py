"""A cloud from elsewhere as shapes need it: in metres, z up, normals toward who looked; all assumptions said."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.build.scans.files import RawCloud, read_cloud
from greenhouse_gym.build.scans.frame import UNITS, guess_unit, guess_up, row_from_file
from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Array, pose
from greenhouse_gym.reconstruction.point_clouds import Cloud, voxel_means
from greenhouse_gym.shapes import RowShapes, ShapeSettings, extract_shapes
from greenhouse_gym.shapes.colors import redness
from greenhouse_gym.shapes.normal_estimation import estimate_normals

_VOXEL = 0.002  # m; as dense as a reconstructed row
_FAR = 100.0  # m from the file's origin beyond which it is moved
_GRAY = 0.5
_GREEN = 0.05  # redness, (R - G) / (R + G), below which something is not red
_AGREE = 0.3  # mean cosine, with normals of its own, at which normals point to one side all in all
_DIRECTIONS = {sign + axis: factor * np.eye(3)[k] for sign, factor in (("", 1.0), ("-", -1.0))
               for k, axis in enumerate("xyz")}  # fmt: skip
_FRUITS, _SURE = 6, 2.0  # fewest fruits that tell which end is up, and standard errors by which they must
_HOLD = (0.004, 0.025)  # m outside of a fruit's skin, where what holds it is

Direction: TypeAlias = str | Sequence[float] | npt.NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class Scan:
    """A cloud that was not recorded with this package's rig.

    Attributes:
        name: Name of its file.
        cloud: One point per 2 mm voxel, metres, z up, y along the row, x away from who looked.
        row_from_file: (4, 4) what brings points of the file, times ``unit``, into that frame.
        unit: Metres of one unit of the file.
        notes: What was assumed and left out, a sentence each.
        up_given: Whether somebody said which way is up.
        path: The file that it was read from.
    """

    name: str
    cloud: Cloud
    row_from_file: Array
    unit: float
    notes: tuple[str, ...]
    up_given: bool = False
    path: Path | None = None


def open_scan(
    source: str | Path | RawCloud,
    units: str | float | None = None,
    up: Direction | None = None,
    seen_from: Sequence[float] | None = None,
) -> Scan:
    """Read a cloud and find out what its file does not say; whatever is given is not guessed.

    Args:
        source: A file of one of `greenhouse_gym.scans.CLOUD_SUFFIXES`, or what was read from one.
        units: "m", "cm" or "mm", or metres per unit.
        up: "x", "y", "z", "-x", "-y" or "-z", or a vector (3,) in the file's frame.
        seen_from: (3,) where the camera or scanner stood, in the file's frame and unit.

    Raises:
        FileFormatError: The file is missing, damaged, or holds too few points.
        InvalidValueError: A value that was given is none.
        UnknownNameError: There is no such unit or direction.
    """
    raw = source if isinstance(source, RawCloud) else read_cloud(source)
    path = None if isinstance(source, RawCloud) else Path(source)
    notes = list(raw.notes)
    unit, said = (_metres(units), "") if units is not None else guess_unit(raw.points)
    notes += [said] if said else []
    points = raw.points * unit
    middle = np.median(points, axis=0)
    origin = middle if np.linalg.norm(middle) > _FAR else np.zeros(3)
    if origin.any():
        notes.append(f"the file's origin is {np.linalg.norm(middle):.0f} m away; it was moved to the cloud's middle")
    if raw.colors is None:
        notes.append("no colors: all is taken as gray, and fruit is told by its form alone")
    colors = np.full_like(points, _GRAY) if raw.colors is None else raw.colors
    normals = np.zeros_like(points) if raw.normals is None else raw.normals
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    cloud, _ = voxel_means(Cloud(points - origin, colors, normals), _VOXEL)
    direction, said = (_direction(up), "") if up is not None else guess_up(cloud.points)
    notes += [said] if said else []
    viewer = None if seen_from is None else _checked(seen_from, "seen_from") * unit - origin
    cloud, said = _oriented(cloud, raw.normals is not None, viewer)
    cloud = cloud.select(np.flatnonzero(cloud.normals.any(axis=1)))  # of a point that stands alone nothing can be told
    notes.append(said)
    turn, said = row_from_file(cloud.points, cloud.normals, direction)
    notes.append(said)
    return Scan(
        path.stem if path else "cloud", cloud.transformed(turn), turn @ pose(translation=-origin), unit, tuple(notes),
        up is not None, path,
    )  # fmt: skip


def extract_from_scan(scan: Scan, settings: ShapeSettings | None = None) -> tuple[Scan, RowShapes]:
    """The shapes of a scan; if its fruit stands upon what should hold it, and nobody said what is up, turned over."""
    settings = settings or ShapeSettings()
    shapes = extract_shapes(scan.cloud.points, scan.cloud.colors, scan.cloud.normals, settings)
    hangs = 0.0 if scan.up_given else fruit_hangs(scan.cloud, shapes)
    if hangs > -_SURE:
        unsure = "up: the fruit does not tell which end is up; give it to be sure"
        return (scan if scan.up_given or hangs > _SURE else replace(scan, notes=(*scan.notes, unsure))), shapes
    over = pose(np.diag([1.0, -1.0, -1.0]))
    note = "up: turned over, since the fruit stood upon what should hold it"
    turned = replace(
        scan, cloud=scan.cloud.transformed(over), row_from_file=over @ scan.row_from_file, notes=(*scan.notes, note)
    )
    cloud = turned.cloud
    return turned, extract_shapes(cloud.points, cloud.colors, cloud.normals, settings)


def fruit_hangs(cloud: Cloud, shapes: RowShapes) -> float:
    """Standard errors by which what is around the fruits, and less red than they are, lies above them; 0 of few."""
    less_red = redness(cloud.colors) < _GREEN
    near = cKDTree(cloud.points[less_red])
    above = []
    for tomato in shapes.tomatoes:
        around = near.data[near.query_ball_point(tomato.center, tomato.radius + _HOLD[1])] - tomato.center
        distance = np.linalg.norm(around, axis=1)
        holds = distance > tomato.radius + _HOLD[0]
        if np.count_nonzero(holds) >= 5:
            above.append(float((around[holds, 2] / distance[holds]).mean()))
    if len(above) < _FRUITS:
        return 0.0
    return float(np.mean(above) / max(float(np.std(above)) / np.sqrt(len(above)), 1e-9))


def _oriented(cloud: Cloud, with_normals: bool, viewer: Array | None) -> tuple[Cloud, str]:
    """The cloud with unit normals toward who looked, and a sentence on where they come from."""
    missing = np.linalg.norm(cloud.normals, axis=1) < 0.5
    own = estimate_normals(cloud.points)
    normals = np.where(missing[:, None], own, cloud.normals)
    said = "normals: " + ("the file's are zero; " if with_normals else "") + "estimated, toward where things bulge"
    if with_normals and not missing.all():
        agree = float((own * normals)[~missing].sum(axis=1).mean())
        if abs(agree) < _AGREE:
            normals, said = own, "normals: the file's point to all sides; estimated instead"
        elif agree < 0:
            normals = np.where(missing[:, None], own, -normals)
            said = "normals: the file's point into the surfaces; turned around"
        else:
            said = "normals: the file's"
        if missing.any():
            said += f"; those of {missing.mean():.0%} of the points are zero, and estimated"
    if viewer is not None:
        away = (normals * (viewer - cloud.points)).sum(axis=1) < 0
        normals, said = np.where(away[:, None], -normals, normals), "normals: toward where it was seen from"
    return replace(cloud, normals=normals), said


def _metres(units: str | float) -> float:
    if isinstance(units, str):
        return UNITS[require_choice("unit", units, UNITS)]
    if not (np.isfinite(units) and units > 0):
        raise InvalidValueError(f"units must be {', '.join(UNITS)} or metres per unit, got {units!r}")
    return float(units)


def _direction(up: Direction) -> Array:
    if isinstance(up, str):
        return np.asarray(_DIRECTIONS[require_choice("direction", up, _DIRECTIONS)])
    vector = _checked(up, "up")
    if np.linalg.norm(vector) < 1e-9:
        raise InvalidValueError(f"up must have a direction, got {up!r}")
    return vector / np.linalg.norm(vector)


def _checked(vector: npt.ArrayLike, name: str) -> Array:
    result = np.asarray(vector, dtype=np.float64)
    if result.shape != (3,) or not np.isfinite(result).all():
        raise InvalidValueError(f"{name} must be three finite numbers, got {vector!r}")
    return result
