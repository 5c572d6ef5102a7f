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


def best_shift(
    first: npt.NDArray[np.bool_],
    second: npt.NDArray[np.bool_],
    axis: int,
    shortest: int,
    longest: int,
    step: int = 2,
) -> Shift | None:
    """Shift the second silhouette a few pixels at a time and keep the shift with the least difference.

    Both directions are tried: the tripod may go either way along the row.

    Args:
        first: (height, width) foreground of one station.
        second: (height, width) foreground of a later one.
        axis: Image axis along which the row passes.
        shortest: Fewest pixels to try, in either direction.
        longest: Most pixels to try.
        step: Pixels between two tries.

    Returns:
        The best shift, or None where no try left any foreground to compare.
    """
    best: Shift | None = None
    tries = list(range(shortest, min(longest, first.shape[axis] - 1) + 1, step))
    for pixels in [*(-s for s in reversed(tries)), *tries]:
        a, b = overlap(first, pixels, axis)
        one, two = first[along(axis, a)], second[along(axis, b)]
        foreground = np.count_nonzero(one) + np.count_nonzero(two)
        if foreground == 0:
            continue
        difference = np.count_nonzero(one != two) / foreground
        if best is None or difference < best.difference:
            best = Shift(pixels, axis, float(difference))
    return best
