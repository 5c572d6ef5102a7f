"""Tomatoes, stems and clutter as arrays, from which objects are made only where someone asks for them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.crops.parts import MAX_LEAF, STEM_KINDS, SpaceBox, Stem, Tomato
from greenhouse_gym.geometry import Array, Box, Capsule, Shape, ShapeArrays, Sphere, arrays_of, shapes_from, unchecked
from greenhouse_gym.geometry.shape_arrays import BOX, ELLIPSOID


class ShapeColumns(NamedTuple):
    """Tomatoes, stems and clutter as arrays; lengths in metres.

    Attributes:
        arrays: All shapes: tomatoes, then stems, then clutter.
        radii: (t,) radii of the spheres of the tomatoes' volumes.
        trusses: (t,) numbers of their trusses.
        ripeness: (t,) their ripeness, nan if unknown.
        kinds: (s,) kinds of stems as indices into `STEM_KINDS`.
        space: (c,) whether a piece of clutter is a `SpaceBox`.
    """

    arrays: ShapeArrays
    radii: Array
    trusses: npt.NDArray[np.int64]
    ripeness: Array
    kinds: npt.NDArray[np.int8]
    space: npt.NDArray[np.bool_]

    @classmethod
    def of(
        cls, tomatoes: Sequence[Tomato] = (), stems: Sequence[Stem] = (), clutter: Sequence[Shape] = ()
    ) -> ShapeColumns:
        """Convert objects to arrays."""
        return cls(
            arrays_of((*(tomato.shape for tomato in tomatoes), *stems, *clutter)),
            np.array([tomato.radius for tomato in tomatoes], dtype=np.float64),
            np.array([tomato.truss for tomato in tomatoes], dtype=np.int64),
            np.array([np.nan if t.ripeness is None else t.ripeness for t in tomatoes], dtype=np.float64),
            np.array([STEM_KINDS.index(stem.kind) for stem in stems], dtype=np.int8),
            np.array([isinstance(shape, SpaceBox) for shape in clutter], dtype=np.bool_),
        )

    @property
    def counts(self) -> tuple[int, int, int]:
        """Numbers of tomatoes, stems and pieces of clutter."""
        return len(self.radii), len(self.kinds), len(self.space)

    @property
    def stem_kinds(self) -> list[str]:
        """(s,) names of the kinds of stems."""
        return [STEM_KINDS[kind] for kind in self.kinds.tolist()]

    @property
    def leaves(self) -> npt.NDArray[np.int64]:
        """(k,) indices into all shapes of the pieces of leaves; see `greenhouse_gym.crops.parts.is_leaf`."""
        first = len(self.radii) + len(self.kinds)
        clutter = self.arrays.select(slice(first, None))
        gutters = (clutter.kinds == BOX) & (clutter.sizes.max(axis=1, initial=0.0) > MAX_LEAF)
        return first + np.flatnonzero(~(self.space | gutters))

    def tomatoes(self) -> tuple[Tomato, ...]:
        """Return the tomatoes."""
        shapes = shapes_from(self.arrays.select(slice(len(self.radii))))
        for k in np.flatnonzero(self.arrays.kinds[: len(self.radii)] == ELLIPSOID).tolist():
            vars(shapes[k])["radius"] = float(self.radii[k])
        ripeness = (None if value != value else value for value in self.ripeness.tolist())
        rows = zip(shapes, self.trusses.tolist(), ripeness, strict=True)
        return tuple(unchecked(Tomato, ("shape", "truss", "ripeness"), rows))

    def stems(self) -> tuple[Stem, ...]:
        """Return the stems."""
        capsules = shapes_from(self.arrays.select(slice(len(self.radii), len(self.radii) + len(self.kinds))))
        rows = ((*vars(capsule).values(), kind) for capsule, kind in zip(capsules, self.stem_kinds, strict=True))
        return tuple(unchecked(Stem, ("start", "end", "radius", "kind"), rows))

    def clutter(self) -> tuple[Sphere | Capsule | Box, ...]:
        """Return the clutter."""
        shapes: list[Any] = shapes_from(self.arrays.select(slice(len(self.radii) + len(self.kinds), None)))
        for k in np.flatnonzero(self.space).tolist():
            shapes[k] = unchecked(SpaceBox, vars(shapes[k]), [vars(shapes[k]).values()])[0]
        return tuple(shapes)

    def with_space(self, boxes: ShapeArrays) -> ShapeColumns:
        """Add boxes of the kind of `SpaceBox` to the clutter."""
        arrays = ShapeArrays.joined([self.arrays, boxes])
        return self._replace(arrays=arrays, space=np.append(self.space, np.ones(len(boxes.kinds), dtype=np.bool_)))

    def with_clutter(self, kept: npt.NDArray[np.bool_]) -> ShapeColumns:
        """Keep some pieces (c,) of clutter."""
        chosen = np.append(np.ones(len(self.radii) + len(self.kinds), dtype=np.bool_), kept)
        return self._replace(arrays=self.arrays.select(np.flatnonzero(chosen)), space=self.space[kept])


def joined(tomatoes: ShapeColumns, stems: ShapeColumns, clutter: ShapeColumns) -> ShapeColumns:
    """Join columns of tomatoes alone, stems alone and clutter alone."""
    arrays = ShapeArrays.joined([tomatoes.arrays, stems.arrays, clutter.arrays])
    return tomatoes._replace(arrays=arrays, kinds=stems.kinds, space=clutter.space)
