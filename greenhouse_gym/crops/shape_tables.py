"""Shapes as a few tables of numbers, which are moved and selected much faster than objects."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.crops.parts import STEM_KINDS, Stem, Tomato
from greenhouse_gym.crops.shape_columns import ShapeColumns
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import (
    Array,
    Box,
    Capsule,
    Ellipsoid,
    Shape,
    ShapeArrays,
    Sphere,
    quaternions_from,
    rotations_from,
    transform,
)
from greenhouse_gym.geometry.shape_arrays import BOX, CAPSULE, ELLIPSOID, SPHERE

MAX_ROWS = 300_000
"""Maximum number of rows of all tables together; a file that claims more is refused."""


class ShapeTables(NamedTuple):
    """Shapes as tables, one row each; lengths in metres.

    Attributes:
        tomatoes: (n, 13) center, radius, truss, ripeness or -1, semi-axes and quaternion (w, x, y, z), both 0 for
            spheres.
        stems: (n, 8) start, end, radius, kind as an index into `STEM_KINDS`.
        spheres: (n, 4) center, radius.
        capsules: (n, 7) start, end, radius.
        boxes: (n, 10) center, half extents, quaternion.
    """

    tomatoes: Array
    stems: Array
    spheres: Array
    capsules: Array
    boxes: Array


COLUMNS: tuple[str, ...] = ("xxxrti" + "aaaqqqq", "xxxxxxrk", "xxxr", "xxxxxxr", "xxxaaaqqqq")
"""Kind of each column of each table: x, a, r lengths, t truss, i ripeness, k kind, q entry of a quaternion."""


class ShapeParts(NamedTuple):
    """Tomatoes, stems and clutter of a scene or a row."""

    tomatoes: tuple[Tomato, ...]
    stems: tuple[Stem, ...]
    clutter: tuple[Sphere | Capsule | Box, ...]

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """All shapes in this order: tomatoes, stems, clutter."""
        return (*(tomato.shape for tomato in self.tomatoes), *self.stems, *self.clutter)

    def select(self, mask: npt.NDArray[np.bool_]) -> ShapeParts:
        """Select shapes by a mask (n,) over `shapes`."""
        first, second = len(self.tomatoes), len(self.tomatoes) + len(self.stems)
        return ShapeParts(
            tuple(itertools.compress(self.tomatoes, mask[:first])),
            tuple(itertools.compress(self.stems, mask[first:second])),
            tuple(itertools.compress(self.clutter, mask[second:])),
        )


def as_tables(tomatoes: Iterable[Tomato], stems: Iterable[Stem], clutter: Iterable[Shape]) -> ShapeTables:
    """Convert tomatoes, stems and clutter to tables."""
    kept = list(clutter)
    boxes = [s for s in kept if isinstance(s, Box)]
    quaternions = quaternions_from([box.rotation for box in boxes])
    rows: tuple[list[list[float]], ...] = (
        [_tomato_row(t) for t in tomatoes],
        [[*s.start, *s.end, s.radius, STEM_KINDS.index(s.kind)] for s in stems],
        [[*s.center, s.radius] for s in kept if isinstance(s, Sphere)],
        [[*s.start, *s.end, s.radius] for s in kept if isinstance(s, Capsule)],
        [[*box.center, *box.half_extents, *q] for box, q in zip(boxes, quaternions, strict=True)],
    )
    return ShapeTables(
        *(
            np.array(table, dtype=np.float64).reshape(-1, len(columns))
            for table, columns in zip(rows, COLUMNS, strict=True)
        )
    )


def from_tables(tables: ShapeTables) -> ShapeParts:
    """Convert tables back to shapes, as `columns_of_tables` does."""
    columns = columns_of_tables(tables)
    return ShapeParts(columns.tomatoes(), columns.stems(), columns.clutter())


def columns_of_tables(tables: ShapeTables) -> ShapeColumns:
    """Convert tables to columns; clutter comes sorted by type.

    Raises:
        InvalidValueError: A table has another shape, holds numbers that are not finite, or describes an impossible
            shape.
    """
    for name, table, columns in zip(ShapeTables._fields, tables, COLUMNS, strict=True):
        if table.ndim != 2 or table.shape[1] != len(columns) or not np.isfinite(table).all():
            raise InvalidValueError(f"{name}: expected a table of {len(columns)} finite columns, got {table.shape}")
    if (count := sum(map(len, tables))) > MAX_ROWS:
        raise InvalidValueError(f"{count} shapes, at most {MAX_ROWS} expected")
    kinds = tables.stems[:, 7]
    if not np.isin(kinds, np.arange(len(STEM_KINDS))).all():
        raise InvalidValueError(f"stems: the kinds are numbers below {len(STEM_KINDS)}, got {np.unique(kinds)}")
    sizes = {"stems": (6, 7), "spheres": (3, 4), "capsules": (6, 7), "boxes": (3, 6)}
    for name, (first, end) in sizes.items():
        if not (getattr(tables, name)[:, first:end] > 0).all():
            raise InvalidValueError(f"{name}: expected positive sizes")
    tomatoes, _, spheres, capsules, boxes = tables
    stretched = np.asarray(tomatoes[:, 6:].any(axis=1))
    measures = np.where(stretched[:, None], tomatoes[:, 6:9], tomatoes[:, 3:4])
    if not ((measures > 0).all() and (tomatoes[:, 5] <= 1).all()):
        raise InvalidValueError("tomatoes: expected positive sizes, and ripeness up to 1")
    return ShapeColumns(
        arrays=_arrays_of(tables, stretched),
        radii=np.where(stretched, np.cbrt(tomatoes[:, 6:9].prod(axis=1)), tomatoes[:, 3]),
        trusses=tomatoes[:, 4].astype(np.int64),
        ripeness=np.where(tomatoes[:, 5] < 0, np.nan, tomatoes[:, 5]),
        kinds=kinds.astype(np.int8),
        space=np.zeros(len(spheres) + len(capsules) + len(boxes), dtype=np.bool_),
    )


def _arrays_of(tables: ShapeTables, stretched: npt.NDArray[np.bool_]) -> ShapeArrays:
    """Return the shapes of tables, of whose tomatoes some are stretched."""
    tomatoes, stems, spheres, capsules, boxes = tables
    arrays = ShapeArrays.empty(sum(map(len, tables)))
    ends = np.cumsum([len(table) for table in tables])
    fruit, stalks, balls, segments, leaves = (slice(end - len(t), end) for end, t in zip(ends, tables, strict=True))
    arrays.starts[:] = np.concatenate([table[:, :3] for table in tables])
    arrays.ends[:] = arrays.starts
    arrays.kinds[fruit], arrays.kinds[leaves] = np.where(stretched, ELLIPSOID, SPHERE), BOX
    arrays.sizes[fruit, 0], arrays.sizes[balls, 0], arrays.sizes[leaves] = tomatoes[:, 3], spheres[:, 3], boxes[:, 3:6]
    arrays.sizes[fruit][stretched] = tomatoes[stretched, 6:9]
    arrays.rotations[fruit][stretched] = rotations_from(tomatoes[stretched, 9:])
    arrays.rotations[leaves] = rotations_from(boxes[:, 6:])
    for part, table in ((stalks, stems), (segments, capsules)):
        arrays.kinds[part], arrays.ends[part], arrays.sizes[part, 0] = CAPSULE, table[:, 3:6], table[:, 6]
    return arrays


def transform_tables(tables: ShapeTables, target_from_source: Array) -> ShapeTables:
    """Express shapes in another frame."""
    result = []
    for table, columns in zip(tables, COLUMNS, strict=True):
        table = table.copy()
        for first in range(0, columns.count("x"), 3):
            table[:, first : first + 3] = transform(target_from_source, table[:, first : first + 3])
        if "q" in columns:
            rotated = np.flatnonzero(table[:, -4:].any(axis=1))
            rotations = target_from_source[:3, :3] @ rotations_from(table[rotated, -4:])
            table[rotated, -4:] = quaternions_from(rotations)
        result.append(table)
    return ShapeTables(*result)


def select_near(tables: ShapeTables, point: Array, distance: float) -> ShapeTables:
    """Keep shapes whose bounding ball comes within a distance (m) of a point (3,)."""
    result = []
    for table, columns in zip(tables, COLUMNS, strict=True):
        ends = [table[:, first : first + 3] for first in range(0, columns.count("x"), 3)]
        sizes = table[:, [k for k, column in enumerate(columns) if column in "ra"]]
        radius = np.linalg.norm(sizes, axis=1) + np.linalg.norm(ends[-1] - ends[0], axis=1) / 2
        away = np.linalg.norm((ends[0] + ends[-1]) / 2 - point, axis=1)
        result.append(table[away <= distance + radius])
    return ShapeTables(*result)


def _tomato_row(tomato: Tomato) -> list[float]:
    shape = tomato.shape
    stretch: Sequence[float] = (
        [*shape.semi_axes, *quaternions_from([shape.rotation])[0]] if isinstance(shape, Ellipsoid) else [0.0] * 7
    )
    return [*shape.center, shape.radius, tomato.truss, -1.0 if tomato.ripeness is None else tomato.ripeness, *stretch]
