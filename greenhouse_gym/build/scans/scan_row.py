"""Turn a scan into a row from which scenes can be cut: stations along it and a floor below."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from greenhouse_gym.build.scans.scan import Scan, extract_from_scan
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import D435_DEPTH, Camera, Rig
from greenhouse_gym.crops.plant_row import STEM_LINE
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import pose
from greenhouse_gym.reconstruction import RowCloud, RowReport
from greenhouse_gym.shapes import RowShapes, ShapeSettings

_STEP = 0.10  # distance between the stations a tripod might have had, m
_SHOULDER = 1.1  # assumed height of fruit above the floor if the floor is unknown, m
_PLAUSIBLE = (-0.1, 4.5)  # range of heights of a row whose file has its zero on the floor, m


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
