"""Visibility of each object of a row in a recording, as a fraction of the pixels that the object alone would cover."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from greenhouse_gym.accuracy.silhouettes import Outlines
from greenhouse_gym.capture.raycast import RowRaycaster
from greenhouse_gym.capture.rig import Camera, Rig
from greenhouse_gym.capture.sensor import StereoNoise
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.geometry import Array, Box, Capsule, Shape, invert

VISIBLE = 0.30
"""Smallest visible fraction of its own pixels at which an object counts as visible."""

FOREGROUND = 0.60
"""Distance from the reference camera along the rig's forward axis beyond which nothing counts as seen, metres."""

MAX_PIECE = 0.02
"""Largest length of the pieces into which stems and leaves are cut, metres, so that hidden parts count as hidden."""

Part = TypeVar("Part", bound=Shape)


class Visibility(NamedTuple):
    """Visible fraction of each object in the frame that shows most of it.

    Attributes:
        in_image: (n,) fraction of the pixels that the object alone would cover in the image. It is hidden by other
            objects, the foreground cut, and the band along one side of the image in which a stereo camera measures no
            depth because its second imager does not see it. This decides whether an object counts as visible.
        whole: (n,) the same as a fraction of the object's whole silhouette: parts beyond the edge of the image count
            as hidden too.
        in_color: (n,) like ``in_image``, except that the band without depth hides nothing: the color image shows it.
    """

    in_image: Array
    whole: Array
    in_color: Array

    @property
    def visible(self) -> npt.NDArray[np.bool_]:
        """Mask (n,) of the objects that count as visible."""
        return self.in_image >= VISIBLE


class Pieces(NamedTuple, Generic[Part]):
    """Shapes cut into pieces.

    Attributes:
        pieces: The pieces.
        owner: (n,) index of the shape that each piece was cut from.
    """

    pieces: tuple[Part, ...]
    owner: npt.NDArray[np.int64]


class VisibleRow(NamedTuple):
    """Visible parts of a row in a recording.

    Attributes:
        tomatoes: Visibility of the row's tomatoes.
        stems: The visible pieces of its stems.
        clutter: The visible pieces of its leaves and gutter.
    """

    tomatoes: Visibility
    stems: tuple[Stem, ...]
    clutter: tuple[Shape, ...]


def visible_row(row: PlantRow, rig: Rig, world_from_station: Array) -> VisibleRow:
    """Return the parts of a row that a rig at true poses (stations, 4, 4) can show."""
    stems, clutter = cut(row.stems), cut(row.clutter)
    objects: list[Shape] = [*(tomato.shape for tomato in row.tomatoes), *stems.pieces, *clutter.pieces]
    first_stem, first_leaf = len(row.tomatoes), len(row.tomatoes) + len(row.stems)
    owner = np.concatenate([np.arange(first_stem), first_stem + stems.owner, first_leaf + clutter.owner])
    enough = np.where(np.arange(len(objects)) < first_stem, 1.0, VISIBLE)  # pieces only need to pass the threshold
    seen = visibility(row, objects, owner, rig, world_from_station, enough=enough)
    ends = np.cumsum([first_stem, len(stems.pieces)])
    of_stems, of_clutter = np.split(seen.visible, ends)[1:]
    return VisibleRow(
        Visibility(*(fractions[:first_stem] for fractions in seen)),
        tuple(stems.pieces[i] for i in np.flatnonzero(of_stems).tolist()),
        tuple(clutter.pieces[i] for i in np.flatnonzero(of_clutter).tolist()),
    )


def visible_tomatoes(row: PlantRow, rig: Rig, world_from_station: Array) -> npt.NDArray[np.bool_]:
    """Return a mask (n,) of the tomatoes of a row that are visible to a rig at true poses (stations, 4, 4)."""
    shapes = [tomato.shape for tomato in row.tomatoes]
    return visibility(row, shapes, np.arange(len(shapes)), rig, world_from_station).visible


def cut(shapes: Sequence[Part], max_length: float = MAX_PIECE) -> Pieces[Part]:
    """Cut capsules along their axes, and boxes along all three, into equal pieces of at most ``max_length`` metres."""
    pieces: list[Part] = []
    owner: list[int] = []
    for index, shape in enumerate(shapes):
        own = _pieces(shape, max_length)
        pieces += own
        owner += [index] * len(own)
    return Pieces(tuple(pieces), np.array(owner, dtype=np.int64))


def _pieces(shape: Part, max_length: float) -> list[Part]:
    if isinstance(shape, Capsule):
        fractions = np.linspace(0.0, 1.0, max(1, int(np.ceil(shape.length / max_length - 1e-9))) + 1)
        ends = shape.start + fractions[:, None] * (shape.end - shape.start)
        return [replace(shape, start=ends[i], end=ends[i + 1]) for i in range(len(ends) - 1)]
    if isinstance(shape, Box):
        counts = np.maximum(1, np.ceil(2 * shape.half_extents / max_length - 1e-9)).astype(int)
        centers = [(2 * np.arange(count) + 1) / count - 1 for count in counts]
        half = shape.half_extents / counts
        return [
            replace(shape, center=shape.center + shape.rotation @ (shape.half_extents * at), half_extents=half)
            for at in product(*centers)
        ]
    return [shape]


def visibility(
    row: PlantRow,
    objects: Sequence[Shape],
    shape: npt.NDArray[np.int64],
    rig: Rig,
    world_from_station: Array,
    foreground: float = FOREGROUND,
    enough: float | Array = 1.0,
) -> Visibility:
    """Return the visible fraction of each object in the frame where it is largest.

    Args:
        row: The grown row.
        objects: Shapes of the row, or parts of them.
        shape: (n,) number of the row's shape that each object is or belongs to, as `RowRaycaster` counts them.
        rig: The cameras.
        world_from_station: (stations, 4, 4) true poses.
        foreground: Distance from the reference camera along the rig's forward axis beyond which nothing is seen,
            metres.
        enough: Fraction, or fractions (n,), of its silhouette above which an object is not examined again.
    """
    caster, outlines = RowRaycaster.of(row), Outlines.of(objects)
    front = rig.cameras[rig.reference].rig_from_camera[0, 3] + foreground
    best = Visibility(*np.zeros((3, len(objects))))
    for pose in world_from_station:
        for camera in rig.cameras.values():
            world_from_camera = pose @ camera.rig_from_camera
            depth, seen = caster.measure(world_from_camera, camera.intrinsics)
            seen[_beyond(depth, camera, front)] = -1
            measured = _in_second_imager(depth, camera)
            here = outlines.seen_from(invert(world_from_camera))
            shows = np.isin(shape, np.unique(seen)) & (best.whole < enough)  # others have no pixel in this frame
            for i in here.in_view(camera.intrinsics, 2 * foreground, shows).tolist():
                alone = here.silhouette(i, camera.intrinsics)
                count = np.count_nonzero(alone.covered)
                if count:
                    colored = alone.covered & (seen[alone.image] == shape[i])
                    shown = np.count_nonzero(colored & measured[alone.image])
                    best.in_image[i] = max(best.in_image[i], shown / count)
                    best.whole[i] = max(best.whole[i], shown / alone.whole)
                    best.in_color[i] = max(best.in_color[i], np.count_nonzero(colored) / count)
    return best


def _beyond(depth: npt.NDArray[np.float32], camera: Camera, front: float) -> npt.NDArray[np.bool_]:
    """Return a mask (h, w) of the pixels whose points lie beyond ``front`` in the rig frame, or that are empty."""
    k, turn = camera.intrinsics, camera.rig_from_camera
    x = (np.arange(k.width) - k.cx)[None, :] / k.fx
    y = (np.arange(k.height) - k.cy)[:, None] / k.fy
    forward = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2]
    with np.errstate(invalid="ignore"):
        return ~(depth * forward + turn[0, 3] < front)


def _in_second_imager(depth: npt.NDArray[np.float32], camera: Camera) -> npt.NDArray[np.bool_]:
    """Return a mask (h, w) of the pixels that a D435's second imager sees too, so that their depth is measured."""
    k = camera.intrinsics
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.arange(k.width) >= k.fx * StereoNoise().baseline / depth)
