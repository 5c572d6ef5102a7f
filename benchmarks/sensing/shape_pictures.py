"""Draw photograph, cloud and outlines of the extracted shapes side by side, one picture per row.

python -m benchmarks.sensing.shape_pictures --workdir rows --source helios --seeds 601 602 603 604 --length 2

Takes 3 minutes per row that `shapes.py` has not measured yet.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.common import RESULTS, parser
from benchmarks.sensing.rows import Row, cloud_of, recording_of
from greenhouse_gym.capture.image_files import encode_png
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.geometry import invert, transform
from greenhouse_gym.reporting.pictures import draw_outlines
from greenhouse_gym.shapes import extract_shapes


def draw(row: Row, workdir: Path, scale: float = 0.5) -> Any:
    """Return the middle station's photograph, the cloud from there, and the photograph with outlines of the shapes."""
    cloud, recording = cloud_of(row, "noisy", workdir), recording_of(row, workdir)
    shapes = extract_shapes(cloud.points, cloud.colors, cloud.normals)
    registered = np.flatnonzero(cloud.registered)
    station = int(registered[len(registered) // 2])
    camera = recording.rig.cameras[recording.rig.reference]
    camera_from_row = invert(cloud.world_from_station[station] @ camera.rig_from_camera)
    photograph = recording[station].frames[recording.rig.reference].color
    points = transform(camera_from_row, cloud.points)
    order = np.argsort(-points[:, 2])  # the nearest last, on top
    kept, v, u = camera.intrinsics.project(points[order])
    picture = np.full_like(photograph, 255)
    picture[v, u] = (255 * cloud.colors[order][kept]).astype(np.uint8)
    found = [*(tomato.shape for tomato in shapes.tomatoes), *shapes.stems]
    outlined = draw_outlines(photograph, found, camera.intrinsics, camera_from_row)
    panels = [np.rot90(image, -1) for image in (photograph, picture, outlined)]  # the cameras stand in portrait
    joined = np.ascontiguousarray(np.concatenate(panels, axis=1))
    return cv2.resize(joined, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def main() -> None:
    """Draw and write the pictures."""
    command = parser(__doc__)
    command.add_argument("--workdir", type=Path, required=True, help="folder of `shapes.py`")
    command.add_argument("--source", default="helios")
    command.add_argument("--seeds", type=int, nargs="+", default=[501, 502, 503, 504])
    command.add_argument("--length", type=float, default=1.0)
    command.add_argument("--out", type=Path, default=RESULTS)
    arguments = command.parse_args()
    for seed in arguments.seeds:
        row = Row(seed, arguments.length, arguments.source)
        write_atomically(
            arguments.out / f"shapes_{row.source}_{row.style}.png", encode_png(draw(row, arguments.workdir))
        )


if __name__ == "__main__":
    main()
