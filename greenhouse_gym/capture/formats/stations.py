"""Stations out of a continuous video: one about every ten centimetres by what the images show, the sharpest near it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.frames import RgbdFrame
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.extras import needs

with needs("reconstruct"):
    import cv2

_CORNERS = 400
_FEWEST = 20  # corners that tell a motion
_NEAR = 1.5  # m; what is farther away tells little of how far the camera went
_AROUND = 0.25  # of the step, within which the sharpest frame is taken


class Chosen(NamedTuple):
    """Stations of a video.

    Attributes:
        frames: Numbers of the frames taken.
        path: (frames,) metres the camera went from the first to each frame.
        lost: Frames at which the motion from the one before could not be told; taken as that before.
        unreadable: Frames that could not be read.
    """

    frames: tuple[int, ...]
    path: npt.NDArray[np.float64]
    lost: tuple[int, ...]
    unreadable: tuple[int, ...]


def choose_stations(recording: Recording, step: float = 0.10, on_frame: Callable[[int], None] | None = None) -> Chosen:
    """Choose frames of a video as stations.

    Args:
        recording: The video, a station each frame; read once, one frame at a time.
        step: Metres the camera should have gone from one station to the next.
        on_frame: Called with the number of each frame read.
    """
    path, sharpness = np.zeros(len(recording)), np.zeros(len(recording))
    lost, unreadable = [], []
    before: RgbdFrame | None = None
    moved = 0.0
    for i in range(len(recording)):
        try:
            frame = recording[i].frames[recording.rig.reference]
        except FileFormatError:
            unreadable.append(i)
            path[i] = path[i - 1] if i else 0.0
            continue
        if before is not None:
            told = motion(before, frame)
            if told is None:
                lost.append(i)
            else:
                moved = told
            path[i] = path[i - 1] + moved
        sharpness[i] = sharpness_of(frame)
        before = frame
        if on_frame:
            on_frame(i)
    frames: list[int] = []
    for k in range(int(path[-1] / step + 0.5) + 1):
        near = np.flatnonzero((np.abs(path - k * step) <= _AROUND * step) & (sharpness > 0))
        best = [int(near[np.argmax(sharpness[near])])] if len(near) else [_nearest(path, sharpness, k * step)]
        frames += [i for i in best if i >= 0 and (not frames or i > frames[-1])]
    return Chosen(tuple(frames), path, tuple(lost), tuple(unreadable))


def _nearest(path: npt.NDArray[np.float64], sharpness: npt.NDArray[np.float64], place: float) -> int:
    usable = np.flatnonzero(sharpness > 0)
    return int(usable[np.argmin(np.abs(path[usable] - place))]) if len(usable) else -1


def motion(first: RgbdFrame, second: RgbdFrame) -> float | None:
    """Metres that the camera went sideways between two frames, by corners and their depth; None if they do not tell."""
    one, two = (cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY) for frame in (first, second))
    near = ((first.depth > 0) & (first.depth < _NEAR)).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(one, _CORNERS, 0.01, 8, mask=near)
    if corners is None or len(corners) < _FEWEST:
        return None
    window = cv2.createHanningWindow(one.shape[::-1], cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(one.astype(np.float32), two.astype(np.float32), window)
    guess = corners + np.array(shift, dtype=np.float32)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        one, two, corners, guess, winSize=(21, 21), maxLevel=3, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    tracked = status.ravel() == 1
    if np.count_nonzero(tracked) < _FEWEST:
        return None
    at = np.rint(corners[tracked, 0]).astype(int)
    depth = first.depth[at[:, 1].clip(0, near.shape[0] - 1), at[:, 0].clip(0, near.shape[1] - 1)]
    pixels = found[tracked, 0] - corners[tracked, 0]
    metres = pixels / [first.intrinsics.fx, first.intrinsics.fy] * depth[:, None]
    return float(np.linalg.norm(np.median(metres[depth > 0], axis=0)))


def sharpness_of(frame: RgbdFrame) -> float:
    """How sharp an image is: variance of its Laplacian, in gray levels squared, plus a trifle."""
    return float(cv2.Laplacian(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), cv2.CV_32F).var()) + 1e-6
