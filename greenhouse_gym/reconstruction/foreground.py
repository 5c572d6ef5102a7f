"""The paper's first step: what is farther than 60 cm is blacked out, what is left is white."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.rig import Camera, Rig

_NEAREST = 0.05  # m; what is nearer is no reading of a depth camera


def foreground_mask(
    depth: npt.NDArray[np.float32], camera: Camera, rig: Rig, farthest: float = 0.60
) -> npt.NDArray[np.bool_]:
    """Pixels with a reading nearer than ``farthest`` metres.

    Distances count along the rig's forward axis from the reference camera, so that the turned cameras keep the same
    slab of the row as the middle one.

    Args:
        depth: (height, width) metres; 0 = no reading.
        camera: The camera.
        rig: Its rig.
        farthest: The cut, metres.
    """
    front = float(rig.cameras[rig.reference].rig_from_camera[0, 3]) + farthest
    return (depth > _NEAREST) & (depth < _cut(camera, front, 2.0 * farthest))


def forward_distance(depth: npt.NDArray[np.float32], camera: Camera) -> npt.NDArray[np.float32]:
    """How far ahead of a camera, along its rig's forward axis, each reading (height, width) is, metres."""
    return np.asarray(depth * _forward(camera), dtype=np.float32)


@lru_cache(maxsize=32)
def _forward(camera: Camera) -> npt.NDArray[np.floating]:
    """(height, width) share of each pixel's depth that goes forward."""
    k = camera.intrinsics
    x, y = (np.arange(k.width) - k.cx) / k.fx, (np.arange(k.height) - k.cy) / k.fy
    return np.asarray(
        camera.rig_from_camera[0, 0] * x[None, :]
        + camera.rig_from_camera[0, 1] * y[:, None]
        + camera.rig_from_camera[0, 2]
    )


@lru_cache(maxsize=32)
def _cut(camera: Camera, front: float, longest: float) -> npt.NDArray[np.float32]:
    """(height, width) depth at which each pixel's ray leaves the slab x < ``front`` of the rig frame."""
    depth = (front - camera.rig_from_camera[0, 3]) / np.maximum(_forward(camera), 1e-6)
    return np.minimum(depth, longest).astype(np.float32)


def foreground_problem(
    depth: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], farthest: float, least: float, most: float
) -> str:
    """Why an image's foreground cannot align a station, or "".

    Args:
        depth: (height, width) metres; 0 = no reading.
        mask: (height, width) its foreground.
        farthest: The cut, metres.
        least: Share of the image that must be foreground.
        most: Share that must not be exceeded: the silhouette of a full image says nothing.
    """
    share = float(mask.mean())
    if least <= share <= most:
        return ""
    seen = depth[depth > 0]
    readings = f"readings at {np.median(seen):.3g} m in the median" if len(seen) else "it has no readings"
    if share > most:
        return f"{share:.1%} of the image is nearer than {farthest:g} m, at most {most:.0%} expected ({readings})"
    return f"{share:.1%} foreground nearer than {farthest:g} m, at least {least:.0%} expected ({readings})"


def blacked_out(color: npt.NDArray[np.uint8], mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8]:
    """A color image (height, width, 3) with everything but the masked pixels black."""
    return np.where(mask[..., None], color, 0).astype(np.uint8)
