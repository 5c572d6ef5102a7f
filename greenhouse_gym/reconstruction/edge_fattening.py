"""Estimate and undo edge fattening (foreground dilation) in stereo depth images.

Block matching gives pixels next to a near surface its disparity, since its texture dominates their windows
("foreground fattening": Scharstein and Szeliski, A taxonomy and evaluation of dense two-frame stereo correspondence
algorithms, 2002). Photographs are free of it: colors change where the near surface really ends. EdgeFattening acts on
slopes as well as at edges, so round objects come out too large on all sides.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.rig import RgbdFrame
from greenhouse_gym.common.extras import needs

with needs("reconstruct"):
    import cv2

_REACH = 8  # px on both sides of a depth edge within which colors must change
_MIN_WIDTH = 4  # px of near surface at an edge
_MIN_GAP = 3  # px next to it that are far or have no reading
_JUMP = 0.03  # m between near and far
_MIN_CHANGE = 60.0  # gray levels, summed over three channels, for a change of color to count
_MIN_EDGES = 500  # for an estimate
_MIN_AGREEING = 0.15  # fraction of the edges that must agree to the pixel; chance gives 0.06
_WINDOW = 3  # px on both sides by which the slope of a surface is judged

_Image: TypeAlias = tuple[npt.NDArray[np.float32], npt.NDArray[np.int16]]
"""Depth (height, width), metres, 0 = no reading, and color (height, width, 3)."""


class EdgeFattening(NamedTuple):
    """Pixels by which foreground covers background."""

    along_rows: int = 0  # to the left and to the right
    along_columns: int = 0  # upwards and downwards


def estimate_edge_fattening(frames: Iterable[RgbdFrame], farthest: float) -> EdgeFattening:
    """Measure how far depth edges lie beyond those of the photographs; 0 where the photographs do not show it.

    The images are of one kind of camera; edges farther than ``farthest`` metres do not count.
    """
    images = [(np.nan_to_num(f.depth, posinf=0.0, neginf=0.0), f.color.astype(np.int16)) for f in frames]
    found = EdgeFattening(_along_rows(images, farthest), _along_columns(images, farthest))
    # fattening along rows also shows along columns where an edge is oblique, and the other way round
    if 0 < found.along_columns <= found.along_rows:
        left = [(undo_edge_fattening(depth, EdgeFattening(found.along_rows, 0)), color) for depth, color in images]
        return found._replace(along_columns=_along_columns(left, farthest))
    if 0 < found.along_rows < found.along_columns:
        left = [(undo_edge_fattening(depth, EdgeFattening(0, found.along_columns)), color) for depth, color in images]
        return found._replace(along_rows=_along_rows(left, farthest))
    return found


def _along_rows(images: Sequence[_Image], farthest: float) -> int:
    zeros = np.zeros((2, 2 * _REACH + 1), dtype=np.int64)
    return _overshoot(sum((_change_histograms(depth, color, farthest) for depth, color in images), start=zeros))


def _along_columns(images: Sequence[_Image], farthest: float) -> int:
    return _along_rows([(depth.T, color.transpose(1, 0, 2)) for depth, color in images], farthest)


def undo_edge_fattening(depth: npt.NDArray[np.float32], fattening: EdgeFattening) -> npt.NDArray[np.float32]:
    """Erode the foreground of a depth image (height, width), metres, 0 = no reading, by its edge fattening.

    Each pixel takes the reading of its neighbor on the side to which the surface recedes. Where that has none, a
    reading on the same surface behind it serves; otherwise the pixel was fattened, and is left without a reading.
    """
    for _ in range(fattening.along_rows):
        depth = _erode_along_rows(depth)
    for _ in range(fattening.along_columns):
        depth = np.ascontiguousarray(_erode_along_rows(np.ascontiguousarray(depth.T)).T)
    return depth


def _change_histograms(
    depth: npt.NDArray[np.floating], color: npt.NDArray[np.int16], farthest: float
) -> npt.NDArray[np.int64]:
    """Count the offsets of the strongest color change from the right and left depth edges of near surfaces.

    Returns:
        (2, offsets) counts. The middle offset is between the last pixel of the near surface and the first one next to
        it; smaller offsets lie within the surface.
    """
    counts = np.zeros((2, 2 * _REACH + 1), dtype=np.int64)
    change = np.abs(np.diff(color, axis=1)).sum(axis=2)
    for side, image, changes in ((0, depth, change), (1, depth[:, ::-1], change[:, ::-1])):
        last = slice(_REACH, image.shape[1] - _REACH - 1)  # columns at which a near surface may end

        def shifted(k: int, image: npt.NDArray[np.floating] = image, last: slice = last) -> npt.NDArray[np.floating]:
            return image[:, last.start + k : last.stop + k]

        end = (shifted(0) > 0) & (shifted(0) < farthest)
        for k in range(1, _MIN_WIDTH):
            end &= (shifted(-k) > 0) & (np.abs(shifted(-k) - shifted(0)) < _JUMP)
        for k in range(1, _MIN_GAP + 1):
            end &= (shifted(k) == 0) | (shifted(k) > shifted(0) + _JUMP)
        rows, columns = np.nonzero(end)
        profiles = changes[rows[:, None], columns[:, None] + np.arange(2 * _REACH + 1)]
        distinct = profiles[profiles.max(axis=1, initial=0) > _MIN_CHANGE]
        counts[side] = np.bincount(distinct.argmax(axis=1), minlength=counts.shape[1])
    return counts


def _overshoot(counts: npt.NDArray[np.int64]) -> int:
    """Return the pixels from color edges to the depth edges beyond them, from counts per offset (2, offsets).

    Where the two images are misaligned, edges on one side lie as much too far out as on the other too far in.
    """
    agree = (counts.sum(axis=1) >= _MIN_EDGES) & (counts.max(axis=1) >= _MIN_AGREEING * counts.sum(axis=1))
    return max(0, int(_REACH - counts.argmax(axis=1).mean())) if agree.all() else 0


def _erode_along_rows(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Erode all surfaces of a depth image (height, width) by a pixel along its rows."""
    inverse = np.zeros_like(depth)
    np.divide(1.0, depth, out=inverse, where=depth > 0)
    right = _mean_on_side(inverse, 1) >= _mean_on_side(inverse, -1)  # where the surface comes nearer to the right
    padded = np.pad(depth, ((0, 0), (2, 2)))
    neighbor = np.where(right, padded[:, 1:-3], padded[:, 3:-1])
    behind = np.where(right, padded[:, :-4], padded[:, 4:])
    bridged = (neighbor == 0) & (behind > 0) & (np.abs(behind - depth) < _JUMP)
    eroded = np.where(bridged, (depth + behind) / 2, neighbor)
    return np.where(depth > 0, eroded, 0.0).astype(np.float32)


def _mean_on_side(inverse: npt.NDArray[np.float32], side: int) -> npt.NDArray[np.floating]:
    """Average the inverse depth (height, width) of the readings within a window on one side; 0 without readings."""
    kernel = np.zeros((3, 2 * _WINDOW + 1), dtype=np.float32)
    kernel[:, _WINDOW + 1 :] = 1.0
    kernel = kernel[:, ::side]

    def summed(image: npt.NDArray[np.float32]) -> npt.NDArray[np.floating]:
        return np.asarray(cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_CONSTANT))

    return summed(inverse) / np.maximum(summed((inverse > 0).astype(np.float32)), 1.0)
