"""Foreground masks: the paper's first step keeps everything nearer than 60 cm."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.rig import Camera, Rig

_NEAREST = 0.05  # m below which a depth camera has no reading
_MIN_FRACTION, _MAX_FRACTION = 0.01, 0.98  # of an image; the silhouette of a full image holds no information


def foreground_mask(
    depth: npt.NDArray[np.float32], camera: Camera, rig: Rig, farthest: float = 0.60
) -> npt.NDArray[np.bool_]:
    """Mask the pixels of a depth image (height, width), metres, with a reading nearer than ``farthest`` metres.

    Distances count along the rig's forward axis from the reference camera, so that the turned cameras keep the same
    slab of the row as the middle one.
    """
    front = float(rig.cameras[rig.reference].rig_from_camera[0, 3]) + farthest
    return (depth > _NEAREST) & (depth < _cut(camera, front, 2.0 * farthest))


def forward_distance(depth: npt.NDArray[np.float32], camera: Camera) -> npt.NDArray[np.float32]:
    """Return the distance of each reading (height, width) along the rig's forward axis, metres."""
    return np.asarray(depth * _forward(camera), dtype=np.float32)


@lru_cache(maxsize=32)
def _forward(camera: Camera) -> npt.NDArray[np.floating]:
    """Return the forward component of each pixel's ray (height, width) per unit of depth."""
    k = camera.intrinsics
    x, y = (np.arange(k.width) - k.cx) / k.fx, (np.arange(k.height) - k.cy) / k.fy
    forward = camera.rig_from_camera[0]
    return np.asarray(forward[0] * x[None, :] + forward[1] * y[:, None] + forward[2])


@lru_cache(maxsize=32)
def _cut(camera: Camera, front: float, longest: float) -> npt.NDArray[np.float32]:
    """Return the depth (height, width) at which each pixel's ray leaves the slab x < ``front`` of the rig frame."""
    depth = (front - camera.rig_from_camera[0, 3]) / np.maximum(_forward(camera), 1e-6)
    return np.minimum(depth, longest).astype(np.float32)


def foreground_problem(depth: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], farthest: float) -> str:
    """Return the reason why the foreground ``mask`` of a depth image cannot align a station, or ""."""
    fraction = float(mask.mean())
    if _MIN_FRACTION <= fraction <= _MAX_FRACTION:
        return ""
    read = depth[depth > 0]
    readings = f"median reading at {np.median(read):.3g} m" if len(read) else "it has no readings"
    if fraction > _MAX_FRACTION:
        limit = f"at most {_MAX_FRACTION:.0%} expected"
        return f"{fraction:.1%} of the image is nearer than {farthest:g} m, {limit} ({readings})"
    return f"{fraction:.1%} foreground nearer than {farthest:g} m, at least {_MIN_FRACTION:.0%} expected ({readings})"


def black_out(color: npt.NDArray[np.uint8], mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8]:
    """Return a color image (height, width, 3) with everything except the masked pixels black."""
    return np.where(mask[..., None], color, 0).astype(np.uint8)


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
