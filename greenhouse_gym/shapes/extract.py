"""Extraction of shapes from a cloud: pipes first, then tomatoes, stems, and boxes for the remaining points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Box, Shape, Sphere
from greenhouse_gym.geometry.point_clouds import Cloud
from greenhouse_gym.shapes.clutter import box_budget, cover_with_boxes
from greenhouse_gym.shapes.evidence import SHELL, Evidence, nearest_shapes, noisy_skin_mask, skin_mask
from greenhouse_gym.shapes.fruit.detection import find_flowers, find_red_tomatoes, find_tomatoes
from greenhouse_gym.shapes.input_checks import WarningLog, downsample, outside_domain, validated_cloud
from greenhouse_gym.shapes.neighborhoods import mend_normals
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.stems.main_stems import find_main_stems, find_strings
from greenhouse_gym.shapes.stems.peduncle_features import STEM_MARGIN, peduncle_candidates
from greenhouse_gym.shapes.stems.pipes import find_pipes
from greenhouse_gym.shapes.stems.traced_peduncles import peduncle_probability, trace_peduncles
from greenhouse_gym.shapes.surface_cloud import (
    SurfaceCloud,
    colorful_mask,
    fine_surface,
    measure_surface,
    pipe_mask,
    redness,
    stem_mask,
)

EXPLAINED = 0.008
"""Distance in metres from a shape within which a point is evidence for it."""

_WITHOUT_NETWORKS = "only red fruit is reported, found by its outline, and no peduncles or pedicels"
_MIN_ALIGNMENT = 0.98  # cosine; development rows have 0.991 to 0.997, normals turned by 12 to 50 degrees 0.84 to 0.96
_MIN_LYING = 0.5  # metres of main stems that show that a cloud lies on its side


@dataclass(frozen=True, eq=False)
class RowShapes:
    """Shapes extracted from a cloud, in its frame (metres).

    Attributes:
        tomatoes: Fruits with truss and ripeness.
        stems: Main stems, peduncles, pedicels, strings and pipes.
        clutter: Boxes around everything else.
        confidence: Confidence of each tomato, 0 to 1.
        flowers: A ball around each flower, which is no obstacle of its own: boxes of the clutter cover its petals.
        evidence: The shape nearest to each point of the cloud, indexed through tomatoes, stems and clutter.
        warnings: Problems that a user should check; each is also raised as a `ShapeWarning`.
    """

    tomatoes: tuple[Tomato, ...] = ()
    stems: tuple[Stem, ...] = ()
    clutter: tuple[Box, ...] = ()
    confidence: tuple[float, ...] = ()
    flowers: tuple[Sphere, ...] = ()
    evidence: Evidence = field(default_factory=lambda: nearest_shapes(np.zeros((0, 3)), (), 0.0))
    warnings: tuple[str, ...] = ()

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """All shapes in the order of the indices in ``evidence``."""
        return (*(tomato.shape for tomato in self.tomatoes), *self.stems, *self.clutter)


def extract_shapes(
    points: npt.ArrayLike,
    colors: npt.ArrayLike,
    normals: npt.ArrayLike | None = None,
    settings: ShapeSettings | None = None,
) -> RowShapes:
    """Extract tomatoes, stems and clutter from a cloud.

    Args:
        points: (n, 3) metres; z up.
        colors: (n, 3) RGB in [0, 1].
        normals: (n, 3) unit vectors out of the surfaces. Where they are left out or zero they are estimated, oriented
            outwards on bulging and rod-like surfaces and elsewhere to the side from which most of the cloud was seen.
        settings: All settings.

    Returns:
        The shapes; empty where the cloud has too few points, with a warning.

    Raises:
        InvalidValueError: The arrays differ in shape, hold NaN or colors above 1, or the cloud is too large to be in
            metres.
    """
    settings = settings or ShapeSettings()
    whole, log = validated_cloud(points, colors, normals), WarningLog()
    thin = downsample(whole, normals is not None, settings, log)
    if not len(thin):
        return RowShapes(evidence=nearest_shapes(whole.points, (), 0.0), warnings=tuple(log.messages))
    cloud = measure_surface(thin)
    if normals is not None and cloud.alignment < _MIN_ALIGNMENT:
        angle = np.degrees(np.arccos(cloud.alignment))
        log.warn(f"the normals of flat surfaces are off by {angle:.0f} degrees; they were estimated instead")
        whole, thin = mend_normals(whole, thin)
        cloud = measure_surface(thin)
    pipes = find_pipes(cloud.select(pipe_mask(cloud)), settings.pipe_radii)
    surface = _without(cloud, pipes, SHELL)
    unlike = outside_domain(cloud)
    if unlike:
        log.warn(f"the cloud is unlike those the networks were fitted to: {unlike}; {_WITHOUT_NETWORKS}")
        tomatoes, confidence, _ = find_red_tomatoes(surface, settings)
    else:
        tomatoes, confidence, bumps = find_tomatoes(surface, fine_surface(whole, surface, settings), settings)
        if bumps:
            log.warn(f"{bumps} small green spheres were left out: their scores show no small fruit, but bent leaves")
    fruits = [tomato.shape for tomato in tomatoes]
    cloud = _without(surface, fruits, SHELL)
    colorful = colorful_mask(cloud.colors)
    woody, pale = cloud.select(colorful if normals is None else stem_mask(cloud)), cloud.select(~colorful)
    main = find_main_stems(woody.points, woody.normals, settings)
    if not main:
        _warn_if_lying(woody, settings, log)
    upright = [*main, *find_strings(pale.points, pale.normals, settings)]
    peduncles: list[Stem] = []
    flowers: tuple[Sphere, ...] = ()
    if not unlike:
        flowers = find_flowers(surface, fruits)
        candidates = peduncle_candidates(surface, tomatoes, main)
        probability = peduncle_probability(candidates)
        peduncles = trace_peduncles(candidates.nodes, probability, tomatoes, main, settings.axis_tolerance)
    stems = (*upright, *peduncles, *pipes)
    cloud = _without(_without(cloud, upright, STEM_MARGIN), peduncles, SHELL)
    cloud = cloud.select(~noisy_skin_mask(cloud.points, cloud.normals, tomatoes))
    skin = surface.points[skin_mask(surface.points, tomatoes)]
    clutter = tuple(cover_with_boxes(cloud.points, cloud.normals, box_budget(cloud.points, settings), settings, skin))
    evidence = nearest_shapes(whole.points, (*fruits, *stems, *clutter), EXPLAINED)
    return RowShapes(tomatoes, stems, clutter, confidence, flowers, evidence, tuple(log.messages))


def _warn_if_lying(woody: Cloud, settings: ShapeSettings, log: WarningLog) -> None:
    """Search main stems along the other axes of a cloud that has none along z, and warn if there are any."""
    woody = woody.select(redness(woody.colors) <= 0.0)  # edges of tables are not green
    for up, order in (("y", [0, 2, 1]), ("x", [2, 1, 0])):
        lying = find_main_stems(woody.points[:, order], woody.normals[:, order], settings)
        if sum(stem.length for stem in lying) > _MIN_LYING:
            log.warn(f"no main stem is upright, but some would be if {up} were up; z must be up")
            return


def _without(cloud: SurfaceCloud, shapes: Sequence[Shape], margin: float) -> SurfaceCloud:
    """Return the points farther than ``margin`` metres outside all shapes."""
    return cloud.select(nearest_shapes(cloud.points, shapes, margin).owner < 0)
