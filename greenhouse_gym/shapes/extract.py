"""One way from a cloud to shapes: pipes first, then tomatoes, stems, and boxes for what is left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Box, Shape
from greenhouse_gym.reconstruction.point_clouds import Cloud
from greenhouse_gym.shapes.bare_peduncles import find_bare_peduncles
from greenhouse_gym.shapes.checks import Notes, checked, thinned
from greenhouse_gym.shapes.clutter import box_budget, cover
from greenhouse_gym.shapes.colors import could_be_pipe, could_be_stem, is_colorful, redness
from greenhouse_gym.shapes.evidence import Evidence, nearest_shapes
from greenhouse_gym.shapes.grids import by_grids
from greenhouse_gym.shapes.likely_places import likelihood
from greenhouse_gym.shapes.peduncles import find_peduncles
from greenhouse_gym.shapes.pipes import find_pipes
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.stems import find_main_stems, find_strings
from greenhouse_gym.shapes.surfaces import SurfaceCloud, look_at_surfaces
from greenhouse_gym.shapes.thin_stems import places_near_fruit
from greenhouse_gym.shapes.tomatoes import find_tomatoes

_LYING = 0.5  # metres of main stems that show that a cloud lies on its side


@dataclass(frozen=True, eq=False)
class RowShapes:
    """What a cloud was found to hold, in the cloud's frame (metres).

    Attributes:
        tomatoes: Fruits with truss and ripeness.
        stems: Main stems, peduncles, pedicels, strings and pipes.
        clutter: Boxes around everything else.
        confidence: How credible each tomato is, 0 to 1.
        evidence: The shape nearest to each point of the cloud, counted through tomatoes, stems and clutter.
        warnings: What a user should look at; each is also raised as a `ShapeWarning`.
    """

    tomatoes: tuple[Tomato, ...] = ()
    stems: tuple[Stem, ...] = ()
    clutter: tuple[Box, ...] = ()
    confidence: tuple[float, ...] = ()
    evidence: Evidence = field(default_factory=lambda: nearest_shapes(np.zeros((0, 3)), (), 0.0))
    warnings: tuple[str, ...] = ()

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """All shapes in the order in which ``evidence`` counts them."""
        return (*(tomato.shape for tomato in self.tomatoes), *self.stems, *self.clutter)


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
        normals: (n, 3) unit vectors out of the surfaces. Left out or zero, they are estimated: out of what bulges or is
            long and thin, and elsewhere to the side from which most of this was seen.
        settings: All settings.

    Returns:
        The shapes; empty where the cloud holds too little, which ``warnings`` says.

    Raises:
        InvalidValueError: The arrays do not fit together, hold NaN or colors beyond 1, or the cloud is too large to be
            in metres.
    """
    settings = settings or ShapeSettings()
    whole, notes = checked(points, colors, normals), Notes()
    thin = thinned(whole, normals is not None, settings, notes)
    if not len(thin):
        return RowShapes(evidence=nearest_shapes(whole.points, (), 0.0), warnings=tuple(notes.messages))
    cloud = look_at_surfaces(thin, settings)
    pipes = find_pipes(cloud.select(could_be_pipe(cloud, settings)), settings)
    cloud = _without(cloud, pipes, settings.shell)
    tomatoes, confidence = find_tomatoes(list(by_grids(whole, cloud, settings)), settings)
    surface = cloud
    fruits = [tomato.shape for tomato in tomatoes]
    skin = cloud.points[nearest_shapes(cloud.points, fruits, settings.skin_noise).owner >= 0]
    cloud = _without(cloud, fruits, settings.shell)
    colorful = is_colorful(cloud.colors, settings)
    woody, pale = cloud.select(colorful if normals is None else could_be_stem(cloud, settings)), cloud.select(~colorful)
    upright = (
        *find_main_stems(woody.points, woody.normals, settings),
        *find_strings(pale.points, pale.normals, settings),
    )
    main = [stem for stem in upright if stem.kind == "main"]
    if not main:
        _say_if_not_upright(woody, settings, notes)
    places = places_near_fruit(surface, tomatoes, main, settings)
    likely = likelihood(places)
    hanging = find_peduncles(places.nodes[likely > settings.min_peduncle], tomatoes, main, settings)
    hanging += find_bare_peduncles(places.nodes[likely > settings.min_bare_peduncle], [*main, *hanging], settings)
    stems = (*upright, *hanging, *pipes)
    cloud = _without(_without(cloud, upright, settings.stem_margin), hanging, settings.shell)
    cloud = _without_skin(cloud, tomatoes, settings)
    clutter = tuple(cover(cloud.points, cloud.normals, box_budget(cloud.points, settings), settings, skin))
    evidence = nearest_shapes(whole.points, (*fruits, *stems, *clutter), settings.explained)
    return RowShapes(tomatoes, stems, clutter, confidence, evidence, tuple(notes.messages))


def _say_if_not_upright(woody: Cloud, settings: ShapeSettings, notes: Notes) -> None:
    """Look for main stems with another axis up, where there are none with z; edges of tables are not green."""
    woody = woody.select(redness(woody.colors) <= 0.0)
    for up, order in (("y", [0, 2, 1]), ("x", [2, 1, 0])):
        lying = find_main_stems(woody.points[:, order], woody.normals[:, order], settings)
        if sum(stem.length for stem in lying) > _LYING:
            notes.say(f"no main stem stands upright, but some would if {up} were up; z must be up")
            return


def _without(cloud: SurfaceCloud, shapes: Sequence[Shape], margin: float) -> SurfaceCloud:
    """The points farther than ``margin`` metres outside all of the shapes."""
    return cloud.select(nearest_shapes(cloud.points, shapes, margin).owner < 0)


def _without_skin(cloud: SurfaceCloud, tomatoes: Sequence[Tomato], settings: ShapeSettings) -> SurfaceCloud:
    """The points that are no skin of a tomato with a sensor's noise: farther off it, or facing elsewhere."""
    near = nearest_shapes(cloud.points, [tomato.shape for tomato in tomatoes], settings.skin_margin).owner
    on = np.flatnonzero(near >= 0)
    outwards = cloud.points[on] - np.array([t.center for t in tomatoes]).reshape(-1, 3)[near[on]]
    facing = (outwards * cloud.normals[on]).sum(axis=1) / np.maximum(np.linalg.norm(outwards, axis=1), 1e-9)
    near[on[facing <= settings.skin_alignment]] = -1
    return cloud.select(near < 0)
