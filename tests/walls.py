"""A textured wall that goes by before a camera, as a video."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from greenhouse_gym.capture import Intrinsics, Recording, RgbdFrame, Station
from greenhouse_gym.capture.formats.single_camera import Lens, Pair, rig_of
from greenhouse_gym.errors import FileFormatError

K = Intrinsics(320, 240, 250.0, 250.0, 159.5, 119.5)
DISTANCE = 0.6
STEP = 0.02  # m from frame to frame


@cache
def texture() -> np.ndarray:
    random = np.random.default_rng(0)
    coarse = random.integers(30, 220, (60, 300, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(coarse, (1500, 240), interpolation=cv2.INTER_CUBIC))


def frame(i: float, blurred: bool = False, gray: float = 1.0, distance: float = DISTANCE) -> RgbdFrame:
    """A textured wall that goes by at 2 cm a frame."""
    start = round(i * STEP * K.fx / DISTANCE)
    color = texture()[:, start : start + K.width]
    color = cv2.blur(color, (15, 15)) if blurred else color
    shade = np.clip(color * gray, 0, 255).astype(np.uint8)
    return RgbdFrame(shade, np.full((K.height, K.width), distance, np.float32), K)


def video(count: int = 40, still: bool = False, unreadable: int = -1, **look: float) -> Recording:
    def load(i: int) -> Station:
        if i == unreadable:
            raise FileFormatError("image", "is damaged")
        blurred = i % 5 == 0 and i > 0 and not look
        return Station({"camera": frame(0 if still else i, blurred, **look)})

    return Recording("video", rig_of(Pair(Lens(K))), count, load)
