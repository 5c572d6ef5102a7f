"""Many shapes as a few tables of numbers, and back: for files in which one JSON object per shape would be too much."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from greenhouse_gym.crops.parts import STEM_KINDS, Stem, Tomato
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, Box, Capsule, Shape, Sphere, quaternions_from, rotations_from, transform

Made = TypeVar("Made", Stem, Sphere, Capsule, Box)

MOST_SHAPES = 300_000
"""Shapes that tables may hold in all; what claims more is not believed."""


class ShapeTables(NamedTuple):
    """Shapes as tables, one row each; lengths in metres.

    Attributes:
        tomatoes: (n, 13) center, radius, truss, ripeness or -1, semi-axes and quaternion (w, x, y, z), both 0 for round
            ones.
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
"""What each column of each table is: x, a, r lengths, t truss, i ripeness, k kind, q of a quaternion."""


def moved(tables: ShapeTables, target_from_source: Array) -> ShapeTables:
    """The same shapes in another frame."""
    result = []
    for table, columns in zip(tables, COLUMNS, strict=True):
        table = table.copy()
        for first in range(0, columns.count("x"), 3):
            table[:, first : first + 3] = transform(target_from_source, table[:, first : first + 3])
        if "q" in columns:
            turned = np.flatnonzero(table[:, -4:].any(axis=1))
            rotations = target_from_source[:3, :3] @ rotations_from(table[turned, -4:])
            table[turned, -4:] = quaternions_from(rotations)
        result.append(table)
    return ShapeTables(*result)


def near(tables: ShapeTables, point: Array, reach: float) -> ShapeTables:
    """What may come within a distance of a point (3,), by balls around the shapes; metres."""
    result = []
    for table, columns in zip(tables, COLUMNS, strict=True):
        ends = [table[:, first : first + 3] for first in range(0, columns.count("x"), 3)]
        sizes = table[:, [k for k, column in enumerate(columns) if column in "ra"]]
        around = np.linalg.norm(sizes, axis=1) + np.linalg.norm(ends[-1] - ends[0], axis=1) / 2
        distance = np.linalg.norm((ends[0] + ends[-1]) / 2 - point, axis=1)
        result.append(table[distance <= reach + around])
    return ShapeTables(*result)


class ShapeParts(NamedTuple):
    """Shapes by what they mean, as a scene and a plant row have them; the clutter sorted by its kind."""

    tomatoes: tuple[Tomato, ...]
    stems: tuple[Stem, ...]
    clutter: tuple[Sphere | Capsule | Box, ...]


def as_tables(tomatoes: Iterable[Tomato], stems: Iterable[Stem], clutter: Iterable[Shape]) -> ShapeTables:
    """Tomatoes, stems and clutter as tables."""
    kept = list(clutter)
    boxes = [s for s in kept if isinstance(s, Box)]
    turns = quaternions_from([box.rotation for box in boxes])
    rows: tuple[list[list[float]], ...] = (
        [_tomato_row(t) for t in tomatoes],
        [[*s.start, *s.end, s.radius, STEM_KINDS.index(s.kind)] for s in stems],
        [[*s.center, s.radius] for s in kept if isinstance(s, Sphere)],
        [[*s.start, *s.end, s.radius] for s in kept if isinstance(s, Capsule)],
        [[*box.center, *box.half_extents, *turn] for box, turn in zip(boxes, turns, strict=True)],
    )
    return ShapeTables(
        *(
            np.array(table, dtype=np.float64).reshape(-1, len(columns))
            for table, columns in zip(rows, COLUMNS, strict=True)
        )
    )


def from_tables(tables: ShapeTables) -> ShapeParts:
    """The shapes that `as_tables` made tables of.

    Raises:
        InvalidValueError: A table has another shape, holds what is not finite, or describes an impossible shape.
    """
    for name, table, columns in zip(ShapeTables._fields, tables, COLUMNS, strict=True):
        if table.ndim != 2 or table.shape[1] != len(columns) or not np.isfinite(table).all():
            raise InvalidValueError(f"{name}: expected a table of {len(columns)} finite columns, got {table.shape}")
    if (count := sum(map(len, tables))) > MOST_SHAPES:
        raise InvalidValueError(f"{count} shapes, at most {MOST_SHAPES} expected")
    kinds = tables.stems[:, 7]
    if not np.isin(kinds, np.arange(len(STEM_KINDS))).all():
        raise InvalidValueError(f"stems: the kinds are numbers below {len(STEM_KINDS)}, got {np.unique(kinds)}")
    sizes = {"stems": (6, 7), "spheres": (3, 4), "capsules": (6, 7), "boxes": (3, 6)}
    for name, (first, end) in sizes.items():
        if not (getattr(tables, name)[:, first:end] > 0).all():
            raise InvalidValueError(f"{name}: expected positive sizes")
    tables = ShapeTables(*(table.copy() for table in tables))
    turns = rotations_from(tables.boxes[:, 6:])
    for table in (*tables, turns):
        table.setflags(write=False)  # shapes do not change, and these are views
    stems = tuple(
        _made(Stem, start=row[:3], end=row[3:6], radius=float(row[6]), kind=STEM_KINDS[int(row[7])])
        for row in tables.stems
    )
    clutter: list[Sphere | Capsule | Box] = [
        *(_made(Sphere, center=row[:3], radius=float(row[3])) for row in tables.spheres),
        *(_made(Capsule, start=row[:3], end=row[3:6], radius=float(row[6])) for row in tables.capsules),
        *(
            _made(Box, center=row[:3], half_extents=row[3:6], rotation=turn)
            for row, turn in zip(tables.boxes, turns, strict=True)
        ),
    ]
    return ShapeParts(tuple(map(_tomato, tables.tomatoes)), stems, tuple(clutter))


def upright_boxes(centers: Array, half_extents: Array) -> list[Box]:
    """Boxes along the axes, of centers (n, 3) and half extents (n, 3), metres: many in the time that few take.

    Raises:
        InvalidValueError: A center is not finite, or a half extent is not positive.
    """
    unturned = np.tile([1.0, 0.0, 0.0, 0.0], (len(centers), 1))
    made = from_tables(as_tables((), (), ())._replace(boxes=np.column_stack([centers, half_extents, unturned])))
    return [box for box in made.clutter if isinstance(box, Box)]


def _made(shape_type: type[Made], **values: Any) -> Made:
    """A shape of values that were checked for all of a table at once: one by one takes ten times as long."""
    shape = object.__new__(shape_type)
    shape.__dict__.update(values)
    return shape


def _tomato_row(t: Tomato) -> list[float]:
    ellipsoid = t.ellipsoid
    stretched: Sequence[float] = (
        [0.0] * 7 if ellipsoid is None else [*ellipsoid.semi_axes, *quaternions_from([ellipsoid.rotation])[0]]
    )
    return [*t.center, t.radius, t.truss, -1.0 if t.ripeness is None else t.ripeness, *stretched]


def _tomato(row: Array) -> Tomato:
    ripeness = None if row[5] < 0 else float(row[5])
    if not row[6:].any():
        return Tomato(row[:3], row[3], int(row[4]), ripeness)
    axes = row[6:9]
    radius = float(np.cbrt(axes.prod()))
    return Tomato(row[:3], radius, int(row[4]), ripeness, axes, rotations_from(row[None, 9:])[0])
