"""By how much near things grow over far ones in depth images, and depth images without it.

Block matching gives pixels beside a near thing its disparity, since its texture rules their windows ("foreground
fattening": Scharstein and Szeliski, A taxonomy and evaluation of dense two-frame stereo correspondence algorithms,
2002). Photographs do not: where colors change beside a depth edge, there the thing ends. What grows at an edge also
grows on a slope, so round things come out too large on all sides.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.frames import RgbdFrame
from greenhouse_gym.common.extras import needs

with needs("reconstruct"):
    import cv2

_REACH = 8  # px on both sides of a depth edge within which colors must change
_WIDE = 4  # px of the near thing, at least
_EMPTY = 3  # px beside it that are far or have no reading, at least
_JUMP = 0.03  # m between near and far
_CHANGE = 60.0  # gray levels, summed over three channels: the least change of color that tells something
_FEWEST = 500  # edges below which nothing is concluded
_CLEAR = 0.15  # share of the edges that must agree to the pixel; chance gives 0.06
_WINDOW = 3  # px on both sides that tell to which side a surface comes nearer

_Image: TypeAlias = tuple[npt.NDArray[np.float32], npt.NDArray[np.int16]]
"""Depth (height, width), metres, 0 = no reading, and color (height, width, 3)."""


class Fattening(NamedTuple):
    """Pixels by which near things grow over far ones.

    Attributes:
        along_rows: To the left and to the right.
        along_columns: Upwards and downwards.
    """

    along_rows: int = 0
    along_columns: int = 0


def edge_fattening(frames: Iterable[RgbdFrame], farthest: float) -> Fattening:
    """Find out how far depth edges lie beyond those of the photographs; none where these do not tell.

    Args:
        frames: Images of one kind of camera, color and depth aligned.
        farthest: Depth beyond which edges do not count, metres.
    """
    images = [(np.nan_to_num(f.depth, posinf=0.0, neginf=0.0), f.color.astype(np.int16)) for f in frames]
    found = Fattening(_along_rows(images, farthest), _along_columns(images, farthest))
    # what grows along rows also grows along columns where an edge runs askew, and the other way round
    if 0 < found.along_columns <= found.along_rows:
        left = [(without_fattening(depth, Fattening(found.along_rows, 0)), color) for depth, color in images]
        return found._replace(along_columns=_along_columns(left, farthest))
    if 0 < found.along_rows < found.along_columns:
        left = [(without_fattening(depth, Fattening(0, found.along_columns)), color) for depth, color in images]
        return found._replace(along_rows=_along_rows(left, farthest))
    return found


def _along_rows(images: Sequence[_Image], farthest: float) -> int:
    nothing = np.zeros((2, 2 * _REACH + 1), dtype=np.int64)
    return _beyond(sum((_changes(depth, color, farthest) for depth, color in images), start=nothing))


def _along_columns(images: Sequence[_Image], farthest: float) -> int:
    return _along_rows([(depth.T, color.transpose(1, 0, 2)) for depth, color in images], farthest)


def without_fattening(depth: npt.NDArray[np.float32], fattening: Fattening) -> npt.NDArray[np.float32]:
    """A depth image (height, width), metres, 0 = no reading, in which near things do not grow over far ones.

    Each pixel takes the reading of its neighbor on the side to which the surface goes away. Where that has none, a
    reading on the same surface behind it serves; else the pixel is what had grown, and is left without a reading.
    """
    for _ in range(fattening.along_rows):
        depth = _receded(depth)
    for _ in range(fattening.along_columns):
        depth = np.ascontiguousarray(_receded(np.ascontiguousarray(depth.T)).T)
    return depth


def _changes(depth: npt.NDArray[np.floating], color: npt.NDArray[np.int16], farthest: float) -> npt.NDArray[np.int64]:
    """How often colors change most at each place around the right and the left ends of near things (2, places).

    The middle is between the last pixel of the near thing and the first one beside it; the places before are within it.
    """
    counts = np.zeros((2, 2 * _REACH + 1), dtype=np.int64)
    change = np.abs(np.diff(color, axis=1)).sum(axis=2)
    for side, image, changes in ((0, depth, change), (1, depth[:, ::-1], change[:, ::-1])):
        last = slice(_REACH, image.shape[1] - _REACH - 1)  # columns at which a near thing may end

        def beside(k: int, image: npt.NDArray[np.floating] = image, last: slice = last) -> npt.NDArray[np.floating]:
            return image[:, last.start + k : last.stop + k]

        end = (beside(0) > 0) & (beside(0) < farthest)
        for k in range(1, _WIDE):
            end &= (beside(-k) > 0) & (np.abs(beside(-k) - beside(0)) < _JUMP)
        for k in range(1, _EMPTY + 1):
            end &= (beside(k) == 0) | (beside(k) > beside(0) + _JUMP)
        rows, columns = np.nonzero(end)
        profiles = changes[rows[:, None], columns[:, None] + np.arange(2 * _REACH + 1)]
        telling = profiles[profiles.max(axis=1, initial=0) > _CHANGE]
        counts[side] = np.bincount(telling.argmax(axis=1), minlength=counts.shape[1])
    return counts


def _beyond(counts: npt.NDArray[np.int64]) -> int:
    """By how many pixels depth edges lie beyond changes of color, from how often these are at each place (2, places).

    Where the two images are not quite aligned, edges on one side lie as much too far out as on the other too far in.
    """
    told = (counts.sum(axis=1) >= _FEWEST) & (counts.max(axis=1) >= _CLEAR * counts.sum(axis=1))
    return max(0, int(_REACH - counts.argmax(axis=1).mean())) if told.all() else 0


def _receded(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """A depth image (height, width) in which all surfaces recede by a pixel along its rows."""
    inverse = np.zeros_like(depth)
    np.divide(1.0, depth, out=inverse, where=depth > 0)
    right = _mean_beside(inverse, 1) >= _mean_beside(inverse, -1)  # where the surface comes nearer to the right
    padded = np.pad(depth, ((0, 0), (2, 2)))
    beside = np.where(right, padded[:, 1:-3], padded[:, 3:-1])
    behind = np.where(right, padded[:, :-4], padded[:, 4:])
    bridged = (beside == 0) & (behind > 0) & (np.abs(behind - depth) < _JUMP)
    receded = np.where(bridged, (depth + behind) / 2, beside)
    return np.where(depth > 0, receded, 0.0).astype(np.float32)


def _mean_beside(inverse: npt.NDArray[np.float32], side: int) -> npt.NDArray[np.floating]:
    """Mean inverse depth (height, width) of the readings within a window on one side; 0 where there are none."""
    kernel = np.zeros((3, 2 * _WINDOW + 1), dtype=np.float32)
    kernel[:, _WINDOW + 1 :] = 1.0
    kernel = kernel[:, ::side]

    def summed(image: npt.NDArray[np.float32]) -> npt.NDArray[np.floating]:
        return np.asarray(cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_CONSTANT))

    return summed(inverse) / np.maximum(summed((inverse > 0).astype(np.float32)), 1.0)
