"""Convert a cloud from another source to metres, z up and normals toward the scanner, with notes on all assumptions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.build.scans.cloud_files import GRAY, MIN_POINTS, RawCloud, read_cloud
from greenhouse_gym.build.scans.frame import UNITS, guess_unit, guess_up, row_from_file, without_strays
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import D435_DEPTH, Camera, Rig
from greenhouse_gym.crops.crop import STEM_LINE
from greenhouse_gym.errors import FileFormatError, InvalidValueError, require_choice
from greenhouse_gym.geometry import Array, pose
from greenhouse_gym.geometry.point_clouds import Cloud, voxel_means
from greenhouse_gym.reconstruction import RowCloud, RowReport
from greenhouse_gym.shapes import RowShapes, ShapeSettings, extract_shapes
from greenhouse_gym.shapes.neighborhoods import estimate_normals
from greenhouse_gym.shapes.surface_cloud import redness

_VOXEL = 0.002  # m; as dense as a reconstructed row
_FAR = 100.0  # m from the file's origin beyond which it is moved
_MIN_EXTENT, _MAX_EXTENT = 0.05, 2000.0  # m, of a cloud; voxels of a larger one cannot be numbered
_GREEN = 0.05  # redness (R - G) / (R + G) below which a point is not red
_AGREE = 0.3  # mean cosine with estimated normals from which the file's normals are consistent
_DIRECTIONS = {sign + axis: factor * np.eye(3)[k] for sign, factor in (("", 1.0), ("-", -1.0))
               for k, axis in enumerate("xyz")}  # fmt: skip
_MIN_FRUITS, _MIN_ERRORS = 6, 2.0  # fruits, and standard errors, that decide which end is up
_HOLD = (0.004, 0.025)  # range of distances from a fruit's skin in which its stalk is, m

Direction: TypeAlias = str | Sequence[float] | npt.NDArray[np.floating]

_STEP = 0.10  # distance between the stations a tripod might have had, m
_SHOULDER = 1.1  # assumed height of fruit above the floor if the floor is unknown, m
_PLAUSIBLE = (-0.1, 4.5)  # range of heights of a row whose file has its zero on the floor, m


@dataclass(frozen=True, eq=False)
class Scan:
    """A cloud that was not recorded with this package's rig.

    Attributes:
        name: Name of its file.
        cloud: One point per 2 mm voxel, metres, z up, y along the row, x away from the scanner.
        row_from_file: (4, 4) pose that brings points of the file, times ``unit``, into that frame.
        unit: Metres of one unit of the file.
        notes: Sentences on what was assumed and left out.
        up_given: Whether the user stated the upward direction.
        path: Its file, or None.
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
    """Read a cloud and guess the properties that neither its file nor the caller gives.

    Args:
        source: A file of one of `greenhouse_gym.build.scans.CLOUD_SUFFIXES`, or its content.
        units: A name in `greenhouse_gym.build.scans.frame.UNITS`, or metres per unit.
        up: "x", "y", "z", "-x", "-y" or "-z", or a vector (3,) in the file's frame.
        seen_from: (3,) position of the camera or scanner in the file's frame and unit.

    Raises:
        FileFormatError: The file is missing or damaged, or the cloud has too few points or another unit.
        InvalidValueError: A given value is invalid.
        UnknownNameError: The unit or direction is unknown.
    """
    raw = without_strays(source if isinstance(source, RawCloud) else read_cloud(source))
    path = None if isinstance(source, RawCloud) else Path(source)
    notes = list(raw.notes)
    if len(raw.points) < MIN_POINTS:
        problem = f"holds {len(raw.points)} points, too few for a plant; expected at least {MIN_POINTS}"
        raise FileFormatError(path or "the cloud", "; ".join((problem, *notes)))
    if units is not None:
        unit, note = _metres(units), ""
    else:
        unit, note = (raw.unit, "") if raw.unit else guess_unit(raw.points)
    notes += [note] if note else []
    with np.errstate(over="ignore"):
        extent = float(np.ptp(raw.points, axis=0).max()) * unit
    if not _MIN_EXTENT < extent < _MAX_EXTENT:
        problem = f"measures {extent:.3g} m, with {unit:g} m per unit; expected {_MIN_EXTENT:g} to {_MAX_EXTENT:g} m"
        raise FileFormatError(path or "the cloud", f"{problem}: give the units")
    points = raw.points * unit
    middle = np.median(points, axis=0)
    origin = middle if np.linalg.norm(middle) > _FAR else np.zeros(3)
    if origin.any():
        notes.append(f"the file's origin is {np.linalg.norm(middle):.0f} m away; it was moved to the cloud's middle")
    if raw.colors is None:
        notes.append("no colors: everything is taken as gray, and fruit is recognized by its form alone")
    colors = np.full_like(points, GRAY) if raw.colors is None else raw.colors
    normals = np.zeros_like(points) if raw.normals is None else raw.normals
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    cloud, _ = voxel_means(Cloud(points - origin, colors, normals), _VOXEL)
    direction, note = (_direction(up), "") if up is not None else guess_up(cloud.points)
    notes += [note] if note else []
    viewer = None if seen_from is None else _checked(seen_from, "seen_from") * unit - origin
    cloud, note = _oriented(cloud, raw.normals is not None, viewer)
    cloud = cloud.select(np.flatnonzero(cloud.normals.any(axis=1)))  # isolated points have none
    notes.append(note)
    turn, note = row_from_file(cloud.points, cloud.normals, direction)
    notes.append(note)
    return Scan(
        path.stem if path else "cloud", cloud.transformed(turn), turn @ pose(translation=-origin), unit, tuple(notes),
        up is not None, path,
    )  # fmt: skip


def extract_from_scan(scan: Scan, settings: ShapeSettings | None = None) -> tuple[Scan, RowShapes]:
    """Extract the shapes of a scan; turn it over if its fruit stands on its stalks and ``up`` was guessed."""
    settings = settings or ShapeSettings()
    shapes = extract_shapes(scan.cloud.points, scan.cloud.colors, scan.cloud.normals, settings)
    hangs = 0.0 if scan.up_given else fruit_hangs(scan.cloud, shapes)
    if hangs > -_MIN_ERRORS:
        unsure = "up: the fruit does not show which end is up; give it to be sure"
        return (scan if scan.up_given or hangs > _MIN_ERRORS else replace(scan, notes=(*scan.notes, unsure))), shapes
    over = pose(np.diag([1.0, -1.0, -1.0]))
    note = "up: turned over, since the fruit stood on its stalks"
    turned = replace(
        scan, cloud=scan.cloud.transformed(over), row_from_file=over @ scan.row_from_file, notes=(*scan.notes, note)
    )
    cloud = turned.cloud
    return turned, extract_shapes(cloud.points, cloud.colors, cloud.normals, settings)


def fruit_hangs(cloud: Cloud, shapes: RowShapes) -> float:
    """Return the mean height of less red points above fruits, in standard errors; 0 with too few fruits."""
    less_red = redness(cloud.colors) < _GREEN
    near = cKDTree(cloud.points[less_red])
    above = []
    for tomato in shapes.tomatoes:
        around = near.data[near.query_ball_point(tomato.center, tomato.radius + _HOLD[1])] - tomato.center
        distance = np.linalg.norm(around, axis=1)
        holds = distance > tomato.radius + _HOLD[0]
        if np.count_nonzero(holds) >= 5:
            above.append(float((around[holds, 2] / distance[holds]).mean()))
    if len(above) < _MIN_FRUITS:
        return 0.0
    return float(np.mean(above) / max(float(np.std(above)) / np.sqrt(len(above)), 1e-9))


def _oriented(cloud: Cloud, with_normals: bool, viewer: Array | None) -> tuple[Cloud, str]:
    """Return the cloud with unit normals toward the scanner, and a sentence on their origin."""
    missing = np.linalg.norm(cloud.normals, axis=1) < 0.5
    own = estimate_normals(cloud.points)
    normals = np.where(missing[:, None], own, cloud.normals)
    note = "normals: " + ("the file's are zero; " if with_normals else "") + "estimated, toward where things bulge"
    if with_normals and not missing.all():
        agree = float((own * normals)[~missing].sum(axis=1).mean())
        if abs(agree) < _AGREE:
            normals, note = own, "normals: the file's point to all sides; estimated instead"
        elif agree < 0:
            normals = np.where(missing[:, None], own, -normals)
            note = "normals: the file's point into the surfaces; turned around"
        else:
            note = "normals: the file's"
        if missing.any():
            note += f"; those of {missing.mean():.0%} of the points are zero, and estimated"
    if viewer is not None:
        away = (normals * (viewer - cloud.points)).sum(axis=1) < 0
        normals, note = np.where(away[:, None], -normals, normals), "normals: toward where it was seen from"
    return replace(cloud, normals=normals), note


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
    vector = vector / max(float(np.abs(vector).max()), 1e-300)  # the squares of the given numbers may overflow
    if np.linalg.norm(vector) < 1e-9:
        raise InvalidValueError(f"up must have a direction, got {up!r}")
    return vector / np.linalg.norm(vector)


def _checked(vector: npt.ArrayLike, name: str) -> Array:
    result = np.asarray(vector, dtype=np.float64)
    if result.shape != (3,) or not np.isfinite(result).all():
        raise InvalidValueError(f"{name} must be three finite numbers, got {vector!r}")
    return result


@dataclass(frozen=True, eq=False, kw_only=True)
class ScannedRow(Recording):
    """A row that was not photographed: its cloud and its shapes, without images. Banks are built from it.

    Attributes:
        scan: The scan with all assumptions.
        row: The cloud; ``observed`` is None, since the free space is unknown.
        shapes: Shapes in the same frame.
    """

    scan: Scan
    row: RowCloud
    shapes: RowShapes


def scanned_row(scan: Scan, floor: float | None = None, settings: ShapeSettings | None = None) -> ScannedRow:
    """Extract the shapes of a scan and return it as a row.

    Args:
        scan: The scan.
        floor: Height of the floor in the scan's frame, metres. By default 0 if that is plausible, else a height at
            which the fruit, or the middle of the cloud, is at the arm's shoulder.
        settings: Settings of shape extraction.

    Raises:
        FileFormatError: The scan contains no shapes.
    """
    scan, shapes = extract_from_scan(scan, settings)
    if not shapes.shapes:
        raise FileFormatError(scan.path or scan.name, f"no shapes found: {'; '.join((*shapes.warnings, *scan.notes))}")
    points = scan.cloud.points
    heights = np.array([tomato.center[2] for tomato in shapes.tomatoes]) if shapes.tomatoes else points[:, 2]
    note = "" if floor is not None else "floor: taken at height 0 of the file"
    if floor is None:
        low, high = np.quantile(points[:, 2], [0.001, 0.999])
        floor = 0.0
        if not (_PLAUSIBLE[0] < low and high < _PLAUSIBLE[1] and low < np.median(heights) - 0.3):
            floor = float(np.median(heights)) - _SHOULDER
            note = f"floor: not in the file; taken {_SHOULDER:g} m below the fruit"
    down, shapes = pose(translation=[0.0, 0.0, -floor]), _lowered(shapes, floor)
    scan = replace(scan, cloud=scan.cloud.transformed(down), row_from_file=down @ scan.row_from_file)
    points = scan.cloud.points
    front = float(np.quantile(points[:, 0], 0.01))
    stems = [(stem.start[0] + stem.end[0]) / 2 for stem in shapes.stems if stem.kind == "main"]
    ahead = (float(np.median(stems)) if stems else front + 0.1) - STEM_LINE
    low, high = np.quantile(points[:, 1], [0.01, 0.99])
    count = max(1, int((high - low) / _STEP))
    along = (low + high) / 2 + _STEP * (np.arange(count) - (count - 1) / 2)
    poses = np.array([pose(translation=[ahead, y, 0.0]) for y in along])
    nearest = np.abs(points[:, 1][:, None] - along).argmin(axis=1).astype(np.int32)
    notes = (*scan.notes, *([note] if note else []), *shapes.warnings)
    row = RowCloud(
        points, scan.cloud.colors, scan.cloud.normals, nearest, np.ones(count, dtype=bool), poses,
        RowReport((), warnings=notes, merged_points=len(points), points=len(points)),
    )  # fmt: skip

    # the file's frame takes the place of a camera's, so that another unit or orientation makes another row
    frame = scan.row_from_file.copy()
    frame[0, 3] = ahead
    rig = Rig({"scan": Camera(D435_DEPTH, frame, scan.unit)}, "scan")
    return ScannedRow(
        scan.name, rig, count, _no_images, scan.path.parent if scan.path else None,
        files=(scan.path,) if scan.path else (), scan=replace(scan, notes=notes), row=row, shapes=shapes,
    )  # fmt: skip


def _no_images(station: int) -> NoReturn:
    raise FileFormatError(f"station {station}", "a scanned cloud has no images")


def _lowered(shapes: RowShapes, floor: float) -> RowShapes:
    """Express shapes in a frame with the floor at height 0."""
    down = np.array([0.0, 0.0, -floor])
    return replace(
        shapes,
        tomatoes=tuple(replace(t, shape=replace(t.shape, center=t.center + down)) for t in shapes.tomatoes),
        stems=tuple(replace(stem, start=stem.start + down, end=stem.end + down) for stem in shapes.stems),
        clutter=tuple(replace(box, center=box.center + down) for box in shapes.clutter),
    )
