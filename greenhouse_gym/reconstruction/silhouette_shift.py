"""Silhouette alignment, the paper's second step: shift one silhouette over the other to the least difference."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt


class Shift(NamedTuple):
    """A shift of silhouettes along an image axis."""

    pixels: int  # row (or column) r + pixels of the first image shows what row r of the second shows
    axis: int  # image axis: 0 = along the rows' index (vertical), 1 = horizontal
    difference: float  # pixels that differ, as a fraction of the foreground in the overlap; 0 = the same, 1 = disjoint


def overlapping_parts(image: npt.NDArray[np.generic], shift: int, axis: int) -> tuple[slice, slice]:
    """Return slices of the first and of the second image (2-D index) that show the same pixels after a shift."""
    size = image.shape[axis]
    first = slice(max(shift, 0), size + min(shift, 0))
    second = slice(max(-shift, 0), size + min(-shift, 0))
    return first, second


def along(axis: int, part: slice) -> tuple[slice, slice]:
    """Return a 2-D index that takes ``part`` along one axis and everything along the other."""
    return (part, slice(None)) if axis == 0 else (slice(None), part)


def best_shifts(
    first: npt.NDArray[np.bool_],
    second: npt.NDArray[np.bool_],
    axis: int,
    shortest: int,
    longest: int,
    step: int = 2,
    count: int = 1,
) -> list[Shift]:
    """Shift the second silhouette (height, width) by ``step`` pixels at a time, from ``shortest`` to ``longest``.

    Both directions are tried: the tripod may move either way along the row. A row repeats itself, so the next best
    minima of the difference can be returned as well.

    Returns:
        Up to ``count`` local minima of the difference, the best first; empty where no try left any foreground.
    """
    tried: list[Shift] = []
    tries = list(range(shortest, min(longest, first.shape[axis] - 1) + 1, step))
    for pixels in [*(-s for s in reversed(tries)), *tries]:
        a, b = overlapping_parts(first, pixels, axis)
        one, two = first[along(axis, a)], second[along(axis, b)]
        foreground = np.count_nonzero(one) + np.count_nonzero(two)
        if foreground == 0:
            continue
        tried.append(Shift(pixels, axis, float(np.count_nonzero(one != two) / foreground)))
    around = [np.inf, *(shift.difference for shift in tried), np.inf]
    minima = [
        shift for k, shift in enumerate(tried) if shift.difference <= around[k] and shift.difference < around[k + 2]
    ]
    return sorted(minima, key=lambda shift: shift.difference)[:count]
