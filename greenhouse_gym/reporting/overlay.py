"""Outlines of shapes drawn over the photograph that they were found in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from greenhouse_gym.accuracy.silhouettes import Outlines
from greenhouse_gym.capture import Recording
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.geometry import Array, Ellipsoid, Shape, Sphere, invert
from greenhouse_gym.reconstruction import RowCloud
from greenhouse_gym.shapes import RowShapes

Image = npt.NDArray[np.uint8]

_TOMATO, _STEM, _CLUTTER = (230, 30, 30), (20, 60, 255), (250, 200, 40)  # RGB


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
