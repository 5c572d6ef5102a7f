"""The paper's second step: shift one silhouette over the other until they differ least."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt


class Shift(NamedTuple):
    """A shift of silhouettes along an image axis.

    Attributes:
        pixels: What is at row (or column) r + pixels in the first image is at r in the second.
        axis: Image axis: 0 = along the rows' index (vertical), 1 = horizontal.
        difference: Pixels that differ, as a share of the foreground in the overlap; 0 = the same, 1 = disjoint.
    """

    pixels: int
    axis: int
    difference: float


def overlap(image: npt.NDArray[np.generic], shift: int, axis: int) -> tuple[slice, slice]:
    """Slices of the first and of the second image (2-D index) that show the same pixels after a shift."""
    size = image.shape[axis]
    first = slice(max(shift, 0), size + min(shift, 0))
    second = slice(max(-shift, 0), size + min(-shift, 0))
    return first, second


def along(axis: int, part: slice) -> tuple[slice, slice]:
    """A 2-D index that takes ``part`` along one axis and everything along the other."""
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
    """Shift the second silhouette a few pixels at a time and keep the shifts with the least difference.

    Both directions are tried: the tripod may go either way along the row. A row repeats itself, so beside the best
    shift the next best valleys of the difference may be asked for.

    Args:
        first: (height, width) foreground of one station.
        second: (height, width) foreground of a later one.
        axis: Image axis along which the row passes.
        shortest: Fewest pixels to try, in either direction.
        longest: Most pixels to try.
        step: Pixels between two tries.
        count: Most shifts wanted.

    Returns:
        Shifts that differ less than their neighbors, the best first; none where no try left any foreground.
    """
    tried: list[Shift] = []
    tries = list(range(shortest, min(longest, first.shape[axis] - 1) + 1, step))
    for pixels in [*(-s for s in reversed(tries)), *tries]:
        a, b = overlap(first, pixels, axis)
        one, two = first[along(axis, a)], second[along(axis, b)]
        foreground = np.count_nonzero(one) + np.count_nonzero(two)
        if foreground == 0:
            continue
        tried.append(Shift(pixels, axis, float(np.count_nonzero(one != two) / foreground)))
    around = [np.inf, *(shift.difference for shift in tried), np.inf]
    valleys = [
        shift for k, shift in enumerate(tried) if shift.difference <= around[k] and shift.difference < around[k + 2]
    ]
    return sorted(valleys, key=lambda shift: shift.difference)[:count]
