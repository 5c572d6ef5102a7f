"""Fruit as a scan shows them, followed by what a color camera at the wrist sees of them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.distance import cdist

from greenhouse_gym.geometry import Array
from greenhouse_gym.scene import Scene

_RED, _FAR = 1.5, 0.7  # red over green and blue on ripe skin, and largest depth of such a pixel, metres
_NEAR, _MIN_PIXELS = 0.02, 8  # metres from where a fruit was expected to its skin, and number of pixels that find it
_FITS, _FIT, _KEPT = 6, 0.002, 0.9  # Gauss-Newton steps, metres by which skin misses a sphere, fraction that is kept
_JUMP = 0.7  # radii by which a fruit moves between images at most; its neighbor hangs farther away
_PEDICEL, _NEXT_TO = 0.012, 0.05  # metres from a fruit to its rachis without a stem, and within which stems count


class FruitMap:
    """Ripe fruit with their current positions; points are in the scene, metres.

    Args:
        scene: The scene as it was scanned.

    Attributes:
        centers: (n, 3) middles of the scene's tomatoes.
        radii: (n,) their radii.
        hanging: (n,) whether they still hang, as far as it is known.
    """

    def __init__(self, scene: Scene):
        self.centers = np.array([tomato.center for tomato in scene.tomatoes]).reshape(-1, 3)
        self.radii = np.array([tomato.radius for tomato in scene.tomatoes])
        self.hanging = np.ones(len(self.radii), dtype=np.bool_)
        rachises = [stem for stem in scene.stems if stem.kind == "peduncle"]
        points = np.array([at for stem in rachises for at in (stem.start, stem.end)]).reshape(-1, 3)
        self._joints = self.centers + np.array([0.0, 0.0, 1.0]) * (self.radii + _PEDICEL)[:, None]
        if len(points):
            apart = cdist(self._joints, points)
            nearest = apart.argmin(axis=1)
            close = apart.min(axis=1) < _NEXT_TO
            self._joints[close] = points[nearest[close]]
        self._joints -= self.centers

    def joint(self, fruit: int) -> Array:
        """Return the presumed start (3,) of a fruit's pedicel."""
        return np.asarray(self.centers[fruit] + self._joints[fruit])

    def see(self, points: Array, color: npt.NDArray[np.uint8], depth: Array) -> None:
        """Follow the fruit that an image shows.

        Args:
            points: (m, 3) points at the pixels.
            color: (m, 3) their colors.
            depth: (m,) their depths; 0 without a reading.
        """
        red, green, blue = color.astype(np.float64).T
        skin = points[(depth > 0) & (depth < _FAR) & (red > _RED * green) & (red > _RED * blue)]
        left = np.flatnonzero(self.hanging)
        if not len(skin) or not len(left):
            return
        gaps = np.abs(cdist(skin, self.centers[left]) - self.radii[left])
        owner, near = gaps.argmin(axis=1), gaps.min(axis=1) < _NEAR
        for k, fruit in enumerate(left.tolist()):
            own = skin[near & (owner == k)]
            center = fitted_center(own, self.centers[fruit], self.radii[fruit])
            jump = np.inf if center is None else float(np.linalg.norm(center - self.centers[fruit]))
            if center is not None and jump < _JUMP * self.radii[fruit]:
                self.centers[fruit] = center


def fitted_center(points: Array, center: Array, radius: float) -> Array | None:
    """Return the middle (3,) of a sphere of a known radius with points (k, 3) on its surface; None if they do not fit.

    Args:
        points: Points, metres; some may belong to other things.
        center: Where the middle was.
        radius: Metres.
    """
    for _ in range(_FITS):
        if len(points) < _MIN_PIXELS:
            return None
        offsets = center - points
        lengths = np.maximum(np.linalg.norm(offsets, axis=1), 1e-6)
        rows, misfit = offsets / lengths[:, None], radius - lengths
        # a weak pull to where it was keeps what a narrow view does not show
        center = center + np.linalg.solve(rows.T @ rows + 0.1 * np.eye(3), rows.T @ misfit)
        misfit = np.abs(np.linalg.norm(points - center, axis=1) - radius)
        points = points[misfit <= max(_FIT, float(np.quantile(misfit, _KEPT)))]
    return center if float(misfit.max()) < 2 * _FIT else None
