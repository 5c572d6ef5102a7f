"""Topology of the plants in a row of loose shapes: trusses with their fruit, and leaves, found by matching ends.

A scene's truth holds fruit, stems and clutter as separate shapes. Consecutive pieces of one organ share an end, a
pedicel starts on its rachis and ends at the skin of its fruit, and a leaflet lies on its petiole, so the organs can be
put together again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.shape_arrays import BOX, CAPSULE, ShapeArrays
from greenhouse_gym.scene import Shapes

JOINED = 3e-4
"""Maximum distance of ends that coincide, metres: truth is stored to 0.1 mm."""

MAX_GAP = 0.012
"""Maximum distance of a pedicel's end from the skin of its fruit, metres."""

MAX_PLATE_DISTANCE = 0.12
"""Maximum distance of a leaflet's middle or ends from its petiole, metres."""

MAX_PLATE = 0.15
"""Maximum half extent of a leaflet, metres; larger boxes are gutters and other fixtures."""

CALYX_REACH = 1.35
"""Distance from the middle of a fruit, in radii, within which small boxes are its calyx."""

CALYX_GAP = 0.015
"""Distance from a pedicel within which boxes are the calyx of its fruit, metres, unless a petiole is nearer."""

Rows = tuple[int, ...]
"""Indices of shapes in the order of `Shapes.obstacles`: fruit, stems, clutter."""


@dataclass(frozen=True, eq=False)
class Fruit:
    """A fruit on its truss.

    Attributes:
        row: Its index among the tomatoes.
        joint: (3,) start of its pedicel on the rachis, metres.
        pedicel: Rows of the pedicel's pieces, from the rachis on; empty if none was found.
        calyx: Rows of the boxes of its calyx.
    """

    row: int
    joint: Array
    pedicel: Rows
    calyx: Rows = ()


@dataclass(frozen=True, eq=False)
class Branch:
    """Organ that hangs on a main stem by one end: a rachis or a petiole.

    Attributes:
        root: (3,) its end at the main stem, metres.
        tip: (3,) its other end, metres.
        rows: Rows of its pieces.
    """

    root: Array
    tip: Array
    rows: Rows


@dataclass(frozen=True, eq=False)
class Truss(Branch):
    """A rachis with its fruit."""

    fruit: tuple[Fruit, ...] = ()


@dataclass(frozen=True, eq=False)
class Leaf(Branch):
    """A petiole with the rows of its leaflets."""

    plates: Rows = ()


@dataclass(frozen=True, eq=False)
class Topology:
    """Trusses, fruit and leaves of a row.

    Attributes:
        trusses: Trusses with at least one fruit.
        leaves: Leaves.
        clutter: Rows of all clutter.
        fixed: Rows of the clutter that is no leaf, such as gutters.
    """

    trusses: tuple[Truss, ...]
    leaves: tuple[Leaf, ...]
    clutter: range
    fixed: Rows

    @cached_property
    def soft(self) -> npt.NDArray[np.int64]:
        """Rows of the clutter that gives way: leaves and calyces."""
        return np.setdiff1d(np.array(self.clutter, dtype=np.int64), self.fixed)

    @cached_property
    def plates(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Rows of the leaflets of all leaves with any, leaf by leaf, and where each of these leaves begins."""
        each = [leaf.plates for leaf in self.leaves if leaf.plates]
        return np.concatenate([*each, []]).astype(np.int64), np.cumsum([0, *(len(one) for one in each)])[:-1]

    def truss_of(self, fruit: int) -> Truss:
        """Return the truss of a fruit, given by its index among the tomatoes."""
        return next(truss for truss in self.trusses if any(one.row == fruit for one in truss.fruit))


def topology_of(shapes: Shapes, name: str) -> Topology:
    """Find the organs of a row.

    Args:
        shapes: The row, such as the truth of a scene.
        name: Name of the scene, for messages.

    Raises:
        InvalidValueError: The shapes have no peduncles or main stems to put trusses together.
    """
    arrays, tomatoes, stems = shapes.arrays, len(shapes.tomatoes), len(shapes.stems)
    kinds = np.array([stem.kind for stem in shapes.stems], dtype=object)
    of_kind = {kind: tomatoes + np.flatnonzero(kinds == kind) for kind in ("main", "peduncle", "pedicel")}
    if not len(of_kind["main"]) or not len(of_kind["peduncle"]) or not tomatoes:
        raise InvalidValueError(
            f"scene {name!r} has no topology: its {tomatoes} fruit need main stems and peduncles as shapes, got "
            f"{len(of_kind['main'])} and {len(of_kind['peduncle'])}; use a scene built from simulated recordings"
        )
    main, rachis = (_Segments.of(arrays, of_kind[kind]) for kind in ("main", "peduncle"))
    branches = [_branch(arrays, rows, main) for rows in _chains(arrays, of_kind["peduncle"])]
    owner = {row: k for k, branch in enumerate(branches) for row in branch.rows}
    fruit = _fruit(arrays, tomatoes, of_kind["pedicel"], rachis)
    clutter = np.arange(tomatoes + stems, len(arrays.kinds))
    petioles = clutter[arrays.kinds[clutter] == CAPSULE]
    plates = clutter[(arrays.kinds[clutter] == BOX) & (arrays.sizes[clutter].max(axis=1) <= MAX_PLATE)]
    fruit, plates = _with_calyx(arrays, fruit, plates, petioles)
    hanging: list[list[Fruit]] = [[] for _ in branches]
    for one in fruit:
        row, _ = rachis.nearest(one.joint[None])
        hanging[owner[int(row[0])]].append(one)
    trusses = [Truss(b.root, b.tip, b.rows, tuple(own)) for b, own in zip(branches, hanging, strict=True) if own]
    fixed = clutter[(arrays.kinds[clutter] == BOX) & (arrays.sizes[clutter].max(axis=1) > MAX_PLATE)]
    leaves = _leaves(arrays, petioles, plates, main)
    everything = range(tomatoes + stems, len(arrays.kinds))
    return Topology(tuple(trusses), leaves, everything, tuple(fixed.tolist()))


@dataclass(frozen=True, eq=False)
class _Segments:
    """Line segments from ``starts`` to ``ends`` (n, 3) of capsules, with their rows (n,)."""

    rows: npt.NDArray[np.int64]
    starts: Array
    ends: Array

    @classmethod
    def of(cls, arrays: ShapeArrays, rows: npt.NDArray[np.int64]) -> _Segments:
        return cls(rows, arrays.starts[rows], arrays.ends[rows])

    def nearest(self, points: Array) -> tuple[npt.NDArray[np.int64], Array]:
        """Return the rows (m,) of the nearest segments to points (m, 3), and their distances."""
        along = self.ends - self.starts
        squares = np.maximum((along * along).sum(axis=1), 1e-18)
        apart = points[:, None] - self.starts
        t = np.clip((apart * along).sum(axis=2) / squares, 0.0, 1.0)
        apart -= t[..., None] * along
        squared = (apart * apart).sum(axis=2)
        nearest = squared.argmin(axis=1)
        return self.rows[nearest], np.sqrt(squared[np.arange(len(points)), nearest])


def _chains(arrays: ShapeArrays, rows: npt.NDArray[np.int64]) -> list[npt.NDArray[np.int64]]:
    """Return the groups of capsules that are connected by common ends."""
    if not len(rows):
        return []
    ends = np.concatenate([arrays.starts[rows], arrays.ends[rows]])
    pairs = cKDTree(ends).query_pairs(JOINED, output_type="ndarray") % len(rows)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(rows), len(rows)))
    _, labels = connected_components(graph, directed=False)
    return [rows[labels == k] for k in range(labels.max() + 1)]


def _branch(arrays: ShapeArrays, rows: npt.NDArray[np.int64], parents: _Segments) -> Branch:
    """Return a chain of capsules from its end nearest to the parents to the farthest one, in this order."""
    ends = np.concatenate([arrays.starts[rows], arrays.ends[rows]])
    root = ends[parents.nearest(ends)[1].argmin()]
    ordered, here, left = [], root, rows
    while len(left):
        gaps = [np.linalg.norm(points[left] - here, axis=1) for points in (arrays.starts, arrays.ends)]
        k = int(np.minimum(*gaps).argmin())
        row = int(left[k])
        here = arrays.starts[row] if gaps[1][k] < gaps[0][k] else arrays.ends[row]
        ordered.append(row)
        left = np.delete(left, k)
    return Branch(root, here, tuple(ordered))


def _fruit(arrays: ShapeArrays, tomatoes: int, pedicels: npt.NDArray[np.int64], rachis: _Segments) -> list[Fruit]:
    """Return the fruit with their pedicels; fruit without one hang on the nearest rachis."""
    branches = [_branch(arrays, rows, rachis) for rows in _chains(arrays, pedicels)]
    tips = np.array([branch.tip for branch in branches]).reshape(-1, 3)
    centers, radii = arrays.starts[:tomatoes], np.cbrt(np.maximum(arrays.sizes[:tomatoes], 0).prod(axis=1))
    radii = np.where(radii > 0, radii, arrays.sizes[:tomatoes, 0])
    free, result = np.ones(len(tips), dtype=np.bool_), []
    for row, (center, radius) in enumerate(zip(centers, radii, strict=True)):
        gaps = np.where(free, np.abs(np.linalg.norm(tips - center, axis=1) - radius), np.inf)
        k = int(gaps.argmin()) if len(gaps) else -1
        if k >= 0 and gaps[k] < MAX_GAP:
            free[k] = False
            result.append(Fruit(row, branches[k].root, branches[k].rows))
        else:
            nearest = int(np.flatnonzero(rachis.rows == rachis.nearest(center[None])[0][0])[0])
            start, end = rachis.starts[nearest], rachis.ends[nearest]
            t = np.clip((center - start) @ (end - start) / max((end - start) @ (end - start), 1e-18), 0.0, 1.0)
            result.append(Fruit(row, start + t * (end - start), ()))
    return result


def _with_calyx(
    arrays: ShapeArrays, fruit: list[Fruit], plates: npt.NDArray[np.int64], petioles: npt.NDArray[np.int64]
) -> tuple[list[Fruit], npt.NDArray[np.int64]]:
    """Return the fruit with the boxes of their calyces, and the other boxes."""
    if not len(plates):
        return fruit, plates
    radii = arrays.sizes[: len(fruit)].max(axis=1)
    distance, owner = cKDTree(arrays.starts[: len(fruit)]).query(arrays.starts[plates])
    small = np.linalg.norm(arrays.sizes[plates], axis=1) < radii[owner]
    own = small & (distance < CALYX_REACH * radii[owner])
    fruit_of = {row: one.row for one in fruit for row in one.pedicel}
    if fruit_of:
        gaps, pedicels = _nearest_piece(arrays, plates, np.array([*fruit_of]))
        beyond, _ = _nearest_piece(arrays, plates, petioles)
        at_pedicel = (gaps < CALYX_GAP) & (gaps < beyond)
        owner = np.where(at_pedicel, [fruit_of[row] for row in pedicels.tolist()], owner)
        own |= at_pedicel
    calyx: list[list[int]] = [[] for _ in fruit]
    for row, k in zip(plates[own].tolist(), owner[own].tolist(), strict=True):
        calyx[k].append(row)
    return [Fruit(f.row, f.joint, f.pedicel, tuple(c)) for f, c in zip(fruit, calyx, strict=True)], plates[~own]


def _nearest_piece(
    arrays: ShapeArrays, plates: npt.NDArray[np.int64], pieces: npt.NDArray[np.int64]
) -> tuple[Array, npt.NDArray[np.int64]]:
    """Return the distances (n,) of boxes, by their middles and ends, from the nearest capsules, and these (n,)."""
    if not len(pieces):
        return np.full(len(plates), np.inf), np.full(len(plates), -1)
    t = np.linspace(0.0, 1.0, 9)[:, None, None]
    samples = arrays.starts[pieces] + t * (arrays.ends[pieces] - arrays.starts[pieces])
    middle = arrays.starts[plates]
    half = arrays.rotations[plates][:, :, 0] * arrays.sizes[plates][:, :1]
    distances, found = cKDTree(samples.reshape(-1, 3)).query(np.stack([middle, middle - half, middle + half]))
    best, each = distances.argmin(axis=0), np.arange(len(plates))
    return distances[best, each], pieces[found[best, each] % len(pieces)]


def _leaves(
    arrays: ShapeArrays, petioles: npt.NDArray[np.int64], plates: npt.NDArray[np.int64], main: _Segments
) -> tuple[Leaf, ...]:
    """Return the leaves: chains of petiole pieces with the leaflets that lie on them."""
    branches = [_branch(arrays, rows, main) for rows in _chains(arrays, petioles)]
    owner = {row: k for k, branch in enumerate(branches) for row in branch.rows}
    own: list[list[int]] = [[] for _ in branches]
    if branches and len(plates):
        for row, gap, petiole in zip(plates, *_nearest_piece(arrays, plates, petioles), strict=True):
            if gap <= MAX_PLATE_DISTANCE:
                own[owner[int(petiole)]].append(int(row))
    return tuple(Leaf(b.root, b.tip, b.rows, tuple(p)) for b, p in zip(branches, own, strict=True))
