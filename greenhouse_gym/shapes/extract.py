"""One way from a cloud to shapes: pipes first, then tomatoes, stems, and boxes for what is left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from greenhouse_gym.crop import Stem, Tomato
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box, Shape
from greenhouse_gym.reconstruction.clouds import Cloud, voxel_means
from greenhouse_gym.shapes.clutter import cover
from greenhouse_gym.shapes.colors import could_be_fruit_or_stem, could_be_peduncle, could_be_pipe, is_colorless
from greenhouse_gym.shapes.evidence import Evidence, nearest_shapes
from greenhouse_gym.shapes.normals import estimate_normals
from greenhouse_gym.shapes.peduncles import find_peduncles, stands_out
from greenhouse_gym.shapes.pipes import find_pipes
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.stems import find_main_stems, find_strings
from greenhouse_gym.shapes.tomatoes import find_tomatoes

_FEWEST = 50  # points that hold a shape


@dataclass(frozen=True, eq=False)
class RowShapes:
    """What a cloud was found to hold, in the cloud's frame (metres).

    Attributes:
        tomatoes: Fruits with truss and ripeness.
        stems: Main stems, peduncles, pedicels, strings and pipes.
        clutter: Boxes around everything else.
        confidence: How credible each tomato is, 0 to 1.
        evidence: The shape nearest to each point of the cloud, counted through tomatoes, stems and clutter.
    """

    tomatoes: tuple[Tomato, ...] = ()
    stems: tuple[Stem, ...] = ()
    clutter: tuple[Box, ...] = ()
    confidence: tuple[float, ...] = ()
    evidence: Evidence = field(default_factory=lambda: nearest_shapes(np.zeros((0, 3)), (), 0.0))

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """All shapes in the order in which ``evidence`` counts them."""
        return (*self.tomatoes, *self.stems, *self.clutter)


def extract_shapes(
    points: npt.ArrayLike,
    colors: npt.ArrayLike,
    normals: npt.ArrayLike | None = None,
    settings: ShapeSettings | None = None,
) -> RowShapes:
    """Find tomatoes, stems and clutter in a cloud.

    Args:
        points: (n, 3) metres; z up.
        colors: (n, 3) RGB in [0, 1].
        normals: (n, 3) unit vectors out of the surfaces. Left out, they are estimated: out of what is long and thin,
            and against x elsewhere.
        settings: All settings.

    Returns:
        The shapes; empty where the cloud holds too little.

    Raises:
        InvalidValueError: The arrays do not fit together, hold NaN, or the cloud is too large to be in metres.
    """
    settings = settings or ShapeSettings()
    whole = _checked(points, colors, normals)
    if len(whole) < _FEWEST:
        return RowShapes(evidence=nearest_shapes(whole.points, (), 0.0))
    cloud, _ = voxel_means(whole, settings.voxel)
    if normals is None:
        cloud = replace(cloud, normals=estimate_normals(cloud.points, settings))
    pipes = find_pipes(cloud.select(could_be_pipe(cloud.colors, settings)), settings)
    cloud = _without(cloud, pipes, settings.shell)
    tomatoes, confidence = find_tomatoes(cloud.points, cloud.normals, cloud.colors, settings)
    green = cloud.select(could_be_peduncle(cloud.colors, settings))
    green = green.select(stands_out(green.points, green.normals, tomatoes, settings))
    cloud = _without(cloud, tomatoes, settings.shell)
    woody, pale = (cloud.select(looks(cloud.colors, settings)) for looks in (could_be_fruit_or_stem, is_colorless))
    upright = (
        *find_main_stems(woody.points, woody.normals, settings),
        *find_strings(pale.points, pale.normals, settings),
    )
    main = [stem for stem in upright if stem.kind == "main"]
    green = _without(green, main, settings.stem_margin)
    thin = find_peduncles(green.points, green.normals, tomatoes, main, settings)
    stems = (*upright, *thin, *pipes)
    cloud = _without(_without(cloud, upright, settings.stem_margin), thin, settings.shell)
    budget = round(settings.clutter_per_metre * float(np.ptp(cloud.points[:, 1]))) if len(cloud) else 0
    clutter = tuple(cover(cloud.points, cloud.normals, max(budget, 10), settings))
    evidence = nearest_shapes(whole.points, (*tomatoes, *stems, *clutter), settings.explained)
    return RowShapes(tomatoes, stems, clutter, confidence, evidence)


def _checked(points: npt.ArrayLike, colors: npt.ArrayLike, normals: npt.ArrayLike | None) -> Cloud:
    p, c = np.asarray(points, dtype=np.float64), np.asarray(colors, dtype=np.float64)
    n = None if normals is None else np.asarray(normals, dtype=np.float64)
    for name, array in (("points", p), ("colors", c), ("normals", n)):
        if array is None:
            continue
        if array.ndim != 2 or array.shape != (len(p), 3):
            raise InvalidValueError(f"{name} must be of shape ({len(p)}, 3), got {array.shape}")
        if not np.isfinite(array).all():
            raise InvalidValueError(f"{name} must be finite, {(~np.isfinite(array)).any(axis=1).sum()} rows are not")
    depth, height, length = np.sort(np.ptp(p, axis=0)) if len(p) else np.zeros(3)
    if length > 200.0 or height > 20.0:
        raise InvalidValueError(
            f"the cloud is {length:.0f} by {height:.0f} by {depth:.0f} m, no row of plants; "
            "expected metres, not millimetres, and no stray points"
        )
    return Cloud(p, c, np.zeros_like(p) if n is None else n)


def _without(cloud: Cloud, shapes: Sequence[Shape], margin: float) -> Cloud:
    """The points farther than ``margin`` metres outside all of the shapes."""
    return cloud.select(nearest_shapes(cloud.points, shapes, margin).owner < 0)
