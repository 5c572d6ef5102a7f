"""The paper's first step: what is farther than 60 cm is blacked out, what is left is white."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.frames import RgbdFrame


def foreground_mask(frame: RgbdFrame, farthest: float = 0.60) -> npt.NDArray[np.bool_]:
    """Pixels (height, width) with a reading nearer than ``farthest`` metres along the camera's own axis."""
    return (frame.depth > 0) & (frame.depth < farthest)


def blacked_out(frame: RgbdFrame, farthest: float = 0.60) -> npt.NDArray[np.uint8]:
    """The color image (height, width, 3) with everything but the foreground black."""
    return np.where(foreground_mask(frame, farthest)[..., None], frame.color, 0).astype(np.uint8)
