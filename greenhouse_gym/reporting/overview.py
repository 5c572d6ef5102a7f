"""A picture of a recording: stations side by side, color above depth."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.errors import FileFormatError

_STATIONS = 6
_HEIGHT = 180  # px
_FARTHEST = 1.5  # m, drawn darkest


def overview(recording: Recording) -> Any:
    """Up to six stations spread over a recording as the reference camera saw them, (h, w, 3) uint8 RGB."""
    columns = []
    for i in np.unique(np.linspace(0, len(recording) - 1, _STATIONS).round().astype(int)).tolist():
        try:
            frame = recording.frame(i, recording.rig.reference)
        except FileFormatError:
            continue
        share = 1.0 - np.clip(frame.depth / _FARTHEST, 0.0, 0.9)
        depth = np.where(frame.depth > 0, 255 * share, 0).astype(np.uint8)
        width = round(_HEIGHT * frame.color.shape[1] / frame.color.shape[0])
        both = (frame.color, np.repeat(depth[..., None], 3, axis=2))
        columns.append(np.concatenate([cv2.resize(image, (width, _HEIGHT)) for image in both]))
    return np.concatenate(columns, axis=1) if columns else np.zeros((2 * _HEIGHT, _HEIGHT, 3), np.uint8)
