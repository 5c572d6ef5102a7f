"""A scan as a row that scenes are cut out of: stands along it, and a floor below."""

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

_STEP = 0.10  # m between the places a tripod might have stood at
_SHOULDER = 1.1  # m above the floor, where fruit is taken to hang when the floor is not known
_PLAUSIBLE = (-0.1, 4.5)  # m above the floor, of all of a row whose file has its zero there


@dataclass(frozen=True, eq=False, kw_only=True)
class ScannedRow(Recording):
    """What a bank is built of where nobody photographed the row: its cloud and its shapes, without images.

    Attributes:
        scan: Where they come from, with all that was assumed.
        row: The cloud; ``observed`` is None, since its depth images are not known.
        shapes: In the same frame.
    """

    scan: Scan
    row: RowCloud
    shapes: RowShapes


def scanned_row(scan: Scan, floor: float | None = None, settings: ShapeSettings | None = None) -> ScannedRow:
    """Shapes of a scan, and the scan as a row of a bank.

    Args:
        scan: The scan.
        floor: Height of the floor in the scan's frame, metres. By default 0 where that is plausible, else so far below
            the fruit, or the cloud's middle, that it hangs before the arm's shoulder.
        settings: Settings of shape extraction.

    Raises:
        FileFormatError: Nothing was found in it.
    """
    scan, shapes = extract_from_scan(scan, settings)
    if not shapes.shapes:
        raise FileFormatError(scan.path or scan.name, f"no shapes found: {'; '.join((*shapes.warnings, *scan.notes))}")
    points = scan.cloud.points
    heights = np.array([tomato.center[2] for tomato in shapes.tomatoes]) if shapes.tomatoes else points[:, 2]
    said = "" if floor is not None else "floor: taken at height 0 of the file"
    if floor is None:
        low, high = np.quantile(points[:, 2], [0.001, 0.999])
        floor = 0.0
        if not (_PLAUSIBLE[0] < low and high < _PLAUSIBLE[1] and low < np.median(heights) - 0.3):
            floor = float(np.median(heights)) - _SHOULDER
            said = f"floor: not in the file; taken {_SHOULDER:g} m below the fruit"
    down, shapes = pose(translation=[0.0, 0.0, -floor]), _lowered(shapes, floor)
    scan = replace(scan, cloud=scan.cloud.transformed(down), row_from_file=down @ scan.row_from_file)
    points = scan.cloud.points
    front = float(np.quantile(points[:, 0], 0.01))
    stems = [(stem.start[0] + stem.end[0]) / 2 for stem in shapes.stems if stem.kind == "main"]
    ahead = (float(np.median(stems)) if stems else front + 0.1) - STEM_LINE
    low, high = np.quantile(points[:, 1], [0.01, 0.99])
    count = max(1, int((high - low) / _STEP))
    along = (low + high) / 2 + _STEP * (np.arange(count) - (count - 1) / 2)
    places = np.array([pose(translation=[ahead, y, 0.0]) for y in along])
    nearest = np.abs(points[:, 1][:, None] - along).argmin(axis=1).astype(np.int32)
    notes = (*scan.notes, *([said] if said else []), *shapes.warnings)
    row = RowCloud(
        points, scan.cloud.colors, scan.cloud.normals, nearest, np.ones(count, dtype=bool), places,
        RowReport((), warnings=notes, merged_points=len(points), points=len(points)),
    )  # fmt: skip

    # the file's frame stands in for a camera's, so that another unit or another side up makes another row
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
    """The shapes in a frame whose zero is at another height."""
    down = np.array([0.0, 0.0, -floor])
    return replace(
        shapes,
        tomatoes=tuple(replace(t, shape=replace(t.shape, center=t.center + down)) for t in shapes.tomatoes),
        stems=tuple(replace(stem, start=stem.start + down, end=stem.end + down) for stem in shapes.stems),
        clutter=tuple(replace(box, center=box.center + down) for box in shapes.clutter),
    )
