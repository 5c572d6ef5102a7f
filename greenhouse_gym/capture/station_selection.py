"""Selection of stations from a continuous video: the sharpest frame about every ten centimetres of motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import RgbdFrame, Station
from greenhouse_gym.common.extras import needs
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array

with needs("reconstruct"):
    import cv2

_CORNERS = 400
_MIN_CORNERS = 20  # for a motion
_NEAR = 1.5  # m; farther corners hardly constrain the motion
_AROUND = 0.25  # of the step, within which the sharpest frame is taken
_CANDIDATES = 6  # frames among which the sharpest is taken
_CLOSE, _FAR = 0.15, 0.5  # of the step, between which the motion of two compared frames should be
_MAX_STRIDE = 8  # frames from one that is read to the next
_WIDE = 480  # pixels; larger images are halved


class StationSelection(NamedTuple):
    """Stations of a video."""

    frames: tuple[int, ...]  # numbers of the frames taken
    path: npt.NDArray[np.float64]  # (frames,) metres of motion from the first to each frame
    lost: tuple[int, ...]  # frames at which the motion from the one before is unknown; taken as that before
    unreadable: tuple[int, ...]  # frames that could not be read


class Odometer:
    """Motion of a camera since its first frame, measured on its frames.

    Frames a good part of ``step`` apart, the metres between stations, are compared. ``moved`` is the motion in metres;
    it is more if it was ``lost`` at some frame.
    """

    def __init__(self, step: float):
        self.moved = 0.0
        self.lost = False
        self._step = step
        self._key: RgbdFrame | None = None
        self._moved_to_key = 0.0

    def add(self, frame: RgbdFrame) -> None:
        """Add the next frame."""
        moved = 0.0 if self._key is None else motion(self._key, frame)
        if moved is None:
            self.lost = True
        else:
            self.moved = self._moved_to_key + moved
        if self._key is None or moved is None or moved > _CLOSE * self._step:
            self._key, self._moved_to_key = frame, self.moved


def choose_stations(
    recording: Recording, step: float = 0.10, on_frame: Callable[[int], None] | None = None
) -> StationSelection:
    """Choose frames of a video as stations, ``step`` metres apart, by motion between frames and by sharpness nearby.

    Images of its reference camera are read, one at a time; ``on_frame`` is called with the number of each frame that is
    read for its motion.

    Raises:
        FileFormatError: No frame can be read; the error is that of the first.
    """
    path, lost, unreadable, known = _measured_path(recording, step, on_frame)
    frames: list[int] = []
    for k in range(int(path[-1] / step + 0.5) + 1):
        near = np.flatnonzero(np.abs(path - k * step) <= _AROUND * step)
        candidates = near[np.linspace(0, len(near) - 1, min(_CANDIDATES, len(near))).round().astype(int)].tolist()
        sharp = {i: known[i] if i in known else _sharpness_of(recording, i, unreadable) for i in candidates}
        best = max(sharp, key=sharp.__getitem__, default=-1)
        if not sharp.get(best, 0.0):
            order = np.argsort(np.abs(path - k * step)).tolist()
            best = next((i for i in order if _sharpness_of(recording, i, unreadable)), -1)
        if best >= 0 and (not frames or best > frames[-1]):
            frames.append(best)
    if not frames:
        recording.frame(min(unreadable, default=0), recording.rig.reference)  # raises its error again
        raise FileFormatError(recording.name, "no frame can be taken as a station")
    return StationSelection(tuple(frames), path, tuple(lost), tuple(sorted(unreadable)))


def select_stations(recording: Recording, stations: Sequence[int]) -> Recording:
    """Return a recording of a subset of the stations of a single pass."""
    return replace(recording, size=len(stations), load=partial(_selected, recording, tuple(stations)))


def _selected(recording: Recording, stations: Sequence[int], i: int) -> Station:
    return recording[stations[i]]


def _measured_path(
    recording: Recording, step: float, on_frame: Callable[[int], None] | None
) -> tuple[Array, list[int], set[int], dict[int, float]]:
    """Return the path (frames,) in metres, frames where it was lost, unreadable ones, and sharpness of those read."""
    known: list[tuple[int, float]] = []  # frames that were read, and their positions
    lost: list[int] = []
    unreadable: set[int] = set()
    sharp: dict[int, float] = {}
    before: RgbdFrame | None = None
    at, stride, speed = 0, 1, 0.0  # speed in metres a frame
    while at < len(recording):
        frame = _frame(recording, at, unreadable)
        if frame is None:
            at += 1
            continue
        if at not in sharp:
            sharp[at] = sharpness(frame)
        if on_frame:
            on_frame(at)
        if before is None:
            known.append((at, 0.0))
        else:
            last, position = known[-1]
            moved = motion(before, frame)
            if stride > 1 and (moved is None or moved > _FAR * step):  # go back and compare closer frames
                at, stride = last + 1, 1
                continue
            if moved is None:
                lost.append(at)
            else:
                speed = moved / (at - last)
            known.append((at, position + speed * (at - last)))
            stride = stride * 2 if moved is not None and moved < _CLOSE * step else max(1, stride // 2)
        before = frame
        at = min(at + min(stride, _MAX_STRIDE), len(recording) - 1) if at < len(recording) - 1 else len(recording)
    if not known:
        return np.zeros(len(recording)), lost, unreadable, sharp
    numbers, metres = np.array(known).T
    return np.interp(np.arange(len(recording)), numbers, metres), lost, unreadable, sharp


def _frame(recording: Recording, i: int, unreadable: set[int]) -> RgbdFrame | None:
    """Read the reference camera's image; None where it cannot be read, which is noted."""
    try:
        return recording.frame(i, recording.rig.reference)
    except FileFormatError:
        unreadable.add(i)
        return None


def _sharpness_of(recording: Recording, i: int, unreadable: set[int]) -> float:
    frame = None if i in unreadable else _frame(recording, i, unreadable)
    return 0.0 if frame is None else sharpness(frame)


def motion(first: RgbdFrame, second: RgbdFrame) -> float | None:
    """Measure the sideways motion between two frames, metres, by corners and their depth; None if it is lost."""
    scale = 2 if first.color.shape[1] > _WIDE else 1
    size = (first.color.shape[1] // scale, first.color.shape[0] // scale)
    one, two = (
        cv2.resize(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
        for frame in (first, second)
    )
    depth = cv2.resize(first.depth, size, interpolation=cv2.INTER_NEAREST)
    near = ((depth > 0) & (depth < _NEAR)).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(one, _CORNERS, 0.01, 8, mask=near)
    if corners is None or len(corners) < _MIN_CORNERS:
        return None
    window = cv2.createHanningWindow(one.shape[::-1], cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(one.astype(np.float32), two.astype(np.float32), window)
    guess = corners + np.array(shift, dtype=np.float32)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        one, two, corners, guess, winSize=(21, 21), maxLevel=3, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    tracked = status.ravel() == 1
    if np.count_nonzero(tracked) < _MIN_CORNERS:
        return None
    at = np.rint(corners[tracked, 0]).astype(int)
    distance = depth[at[:, 1].clip(0, near.shape[0] - 1), at[:, 0].clip(0, near.shape[1] - 1)]
    pixels = scale * (found[tracked, 0] - corners[tracked, 0])
    metres = pixels / [first.intrinsics.fx, first.intrinsics.fy] * distance[:, None]
    return float(np.linalg.norm(np.median(metres[distance > 0], axis=0)))


def sharpness(frame: RgbdFrame) -> float:
    """Return the variance of the image's Laplacian, in gray levels squared, always above 0."""
    return float(cv2.Laplacian(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), cv2.CV_32F).var()) + 1e-6
