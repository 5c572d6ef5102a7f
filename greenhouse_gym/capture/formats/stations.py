"""Stations out of a continuous video: one about every ten centimetres by what the images show, the sharpest near it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.frames import RgbdFrame
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.common.extras import needs
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array

with needs("reconstruct"):
    import cv2

_CORNERS = 400
_FEWEST = 20  # corners that tell a motion
_NEAR = 1.5  # m; what is farther away tells little of how far the camera went
_AROUND = 0.25  # of the step, within which the sharpest frame is taken
_CANDIDATES = 6  # frames of which the sharpest is taken, at most
_CLOSE, _FAR = 0.15, 0.5  # of the step, between which two frames that tell how far the camera went should be
_LONGEST = 8  # frames that are passed over at once, at most
_WIDE = 480  # pixels; larger images are looked at in half their size


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


class Odometer:
    """How far a camera went since the first frame it saw, by what the frames show.

    Args:
        step: Metres after which a station is due; frames a good part of that apart are compared.

    Attributes:
        moved: Metres gone.
        lost: Whether the motion could not be told at some frame; it is then more than ``moved`` says.
    """

    def __init__(self, step: float):
        self.moved = 0.0
        self.lost = False
        self._step = step
        self._key: RgbdFrame | None = None
        self._gone = 0.0  # up to the frame that others are compared with

    def see(self, frame: RgbdFrame) -> None:
        """Look at the next frame."""
        told = 0.0 if self._key is None else motion(self._key, frame)
        if told is None:
            self.lost = True
        else:
            self.moved = self._gone + told
        if self._key is None or told is None or told > _CLOSE * self._step:
            self._key, self._gone = frame, self.moved


def choose_stations(recording: Recording, step: float = 0.10, on_frame: Callable[[int], None] | None = None) -> Chosen:
    """Choose frames of a video as stations.

    How far the camera went is told by frames a part of a step apart; how sharp they are, by some near each station.

    Args:
        recording: The video, a station each frame; images of its reference camera are read, one at a time.
        step: Metres the camera should have gone from one station to the next.
        on_frame: Called with the number of each frame that was looked at on the way.
    """
    path, lost, unreadable, known = _followed(recording, step, on_frame)
    frames: list[int] = []
    for k in range(int(path[-1] / step + 0.5) + 1):
        near = np.flatnonzero(np.abs(path - k * step) <= _AROUND * step)
        some = near[np.linspace(0, len(near) - 1, min(_CANDIDATES, len(near))).round().astype(int)]
        sharpness = {i: known[i] if i in known else _sharpness(recording, i, unreadable) for i in some.tolist()}
        best = max(sharpness, key=sharpness.__getitem__, default=-1)
        if not sharpness.get(best, 0.0):
            best = _nearest(recording, path, k * step, unreadable)
        if best >= 0 and (not frames or best > frames[-1]):
            frames.append(best)
    return Chosen(tuple(frames), path, tuple(lost), tuple(sorted(unreadable)))


def _followed(
    recording: Recording, step: float, on_frame: Callable[[int], None] | None
) -> tuple[Array, list[int], set[int], dict[int, float]]:
    """Path (frames,) in metres, frames at which it was lost, those that could not be read; sharpness of what was."""
    known: list[tuple[int, float]] = []  # frames that were looked at, and how far they are
    lost: list[int] = []
    unreadable: set[int] = set()
    sharpness: dict[int, float] = {}
    before: RgbdFrame | None = None
    at, stride, speed = 0, 1, 0.0  # speed in metres a frame
    while at < len(recording):
        frame = _frame(recording, at, unreadable)
        if frame is None:
            at += 1
            continue
        if at not in sharpness:
            sharpness[at] = sharpness_of(frame)
        if on_frame:
            on_frame(at)
        if before is None:
            known.append((at, 0.0))
        else:
            last, gone = known[-1]
            told = motion(before, frame)
            if stride > 1 and (told is None or told > _FAR * step):  # look more closely
                at, stride = last + 1, 1
                continue
            if told is None:
                lost.append(at)
            else:
                speed = told / (at - last)
            known.append((at, gone + speed * (at - last)))
            stride = stride * 2 if told is not None and told < _CLOSE * step else max(1, stride // 2)
        before = frame
        at = min(at + min(stride, _LONGEST), len(recording) - 1) if at < len(recording) - 1 else len(recording)
    if not known:
        return np.zeros(len(recording)), lost, unreadable, sharpness
    numbers, metres = np.array(known).T
    return np.interp(np.arange(len(recording)), numbers, metres), lost, unreadable, sharpness


def _frame(recording: Recording, i: int, unreadable: set[int]) -> RgbdFrame | None:
    """The reference camera's image, or None where it cannot be read, which is noted."""
    try:
        return recording.frame(i, recording.rig.reference)
    except FileFormatError:
        unreadable.add(i)
        return None


def _sharpness(recording: Recording, i: int, unreadable: set[int]) -> float:
    frame = None if i in unreadable else _frame(recording, i, unreadable)
    return 0.0 if frame is None else sharpness_of(frame)


def _nearest(recording: Recording, path: Array, place: float, unreadable: set[int]) -> int:
    """The readable frame nearest to a place, or -1."""
    return next((int(i) for i in np.argsort(np.abs(path - place)) if _sharpness(recording, int(i), unreadable)), -1)


def motion(first: RgbdFrame, second: RgbdFrame) -> float | None:
    """Metres that the camera went sideways between two frames, by corners and their depth; None if they do not tell."""
    smaller = 2 if first.color.shape[1] > _WIDE else 1
    size = (first.color.shape[1] // smaller, first.color.shape[0] // smaller)
    one, two = (
        cv2.resize(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
        for frame in (first, second)
    )
    depth = cv2.resize(first.depth, size, interpolation=cv2.INTER_NEAREST)
    near = ((depth > 0) & (depth < _NEAR)).astype(np.uint8)
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
    there = depth[at[:, 1].clip(0, near.shape[0] - 1), at[:, 0].clip(0, near.shape[1] - 1)]
    pixels = smaller * (found[tracked, 0] - corners[tracked, 0])
    metres = pixels / [first.intrinsics.fx, first.intrinsics.fy] * there[:, None]
    return float(np.linalg.norm(np.median(metres[there > 0], axis=0)))


def sharpness_of(frame: RgbdFrame) -> float:
    """How sharp an image is: variance of its Laplacian, in gray levels squared, plus a trifle."""
    return float(cv2.Laplacian(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), cv2.CV_32F).var()) + 1e-6
