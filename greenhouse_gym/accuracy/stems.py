"""How much of the stems was found, how much of what was found is none, and how well axes and radii agree: by length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.accuracy.shares import share
from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.geometry import Array, Capsule, closest_on_segments

AXIS_DISTANCE = 0.010
"""Metres that two axes may lie apart to count as the same stem."""

AXIS_ANGLE = float(np.deg2rad(30.0))
"""Radians that such axes may be turned against each other."""

SPACING = 0.005
"""Metres of axis that one sample stands for, at most."""


@dataclass(frozen=True, eq=False)
class StemComparison:
    """The stems of one kind, of one row or of several; lengths are metres of axis.

    Attributes:
        visible: True length that was visible.
        found: Part of the visible length that lies by a found stem of any kind.
        found_as_such: Part of the visible length that lies by a found stem of the same kind.
        extracted: Length found as this kind.
        false: Part of the extracted length that lies by no true stem of any kind.
        on_petioles: Part of the false length that lies by another true capsule: a leaf's stalk.
        axis_error: (k,) metres from samples of the visible true axes to the nearest found axis of the same kind, where
            found as such.
        radius_error: (k,) relative, unsigned, at the same places.
    """

    visible: float
    found: float
    found_as_such: float
    extracted: float
    false: float
    on_petioles: float
    axis_error: Array
    radius_error: Array

    @property
    def recall(self) -> float:
        """Share of the visible length by a found stem of any kind."""
        return share(self.found, self.visible)

    @property
    def recall_as_such(self) -> float:
        """Share of the visible length by a found stem of the same kind."""
        return share(self.found_as_such, self.visible)

    @property
    def false_share(self) -> float:
        """Share of the extracted length by no true stem."""
        return share(self.false, self.extracted)


class _Samples(NamedTuple):
    points: Array  # (n, 3)
    directions: Array  # (n, 3) unit vectors
    lengths: Array  # (n,) metres each stands for
    owner: npt.NDArray[np.int64]  # (n,) index of the stem


def compare_stems(
    true: Sequence[Stem], visible: Sequence[Stem], others: Sequence[Capsule], found: Sequence[Stem], kind: str
) -> StemComparison:
    """Compare the stems of one kind with those found.

    A place on an axis lies by another axis if that is within `AXIS_DISTANCE` and runs within `AXIS_ANGLE` of it there.

    Args:
        true: All stems of the row, of every kind.
        visible: The stems, or parts of stems, that were visible.
        others: Capsules of the row that are no stems: the stalks of leaves.
        found: Stems found, in the frame of the true ones.
        kind: The kind of interest.
    """
    wanted = [stem for stem in visible if stem.kind == kind]
    named = [stem for stem in found if stem.kind == kind]
    places, claimed = _samples(wanted), _samples(named)
    any_kind, _ = _nearest(places, found)
    distance, index = _nearest(places, named)
    as_such = np.isfinite(distance)
    radii = np.array([stem.radius for stem in named])
    true_radii = np.array([stem.radius for stem in wanted])
    false = ~np.isfinite(_nearest(claimed, true)[0])
    on_petioles = false & np.isfinite(_nearest(claimed, others)[0])
    return StemComparison(
        visible=float(places.lengths.sum()),
        found=float(places.lengths[np.isfinite(any_kind)].sum()),
        found_as_such=float(places.lengths[as_such].sum()),
        extracted=float(claimed.lengths.sum()),
        false=float(claimed.lengths[false].sum()),
        on_petioles=float(claimed.lengths[on_petioles].sum()),
        axis_error=distance[as_such],
        radius_error=np.abs(radii[index[as_such]] / true_radii[places.owner[as_such]] - 1.0),
    )


def pool_stems(comparisons: Sequence[StemComparison]) -> StemComparison:
    """Several rows, or kinds, as one."""
    return StemComparison(
        visible=sum(c.visible for c in comparisons),
        found=sum(c.found for c in comparisons),
        found_as_such=sum(c.found_as_such for c in comparisons),
        extracted=sum(c.extracted for c in comparisons),
        false=sum(c.false for c in comparisons),
        on_petioles=sum(c.on_petioles for c in comparisons),
        axis_error=np.concatenate([c.axis_error for c in comparisons]),
        radius_error=np.concatenate([c.radius_error for c in comparisons]),
    )


def _samples(stems: Sequence[Capsule]) -> _Samples:
    """Places along the axes, in the middle of equal parts of at most `SPACING`; a ball has none."""
    points, directions, lengths, owner = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)], []
    for index, stem in enumerate(stems):
        if stem.length < 1e-6:
            continue
        count = int(np.ceil(stem.length / SPACING))
        share = (np.arange(count) + 0.5) / count
        points.append(stem.start + share[:, None] * (stem.end - stem.start))
        directions.append(np.tile((stem.end - stem.start) / stem.length, (count, 1)))
        lengths.append(np.full(count, stem.length / count))
        owner += [index] * count
    return _Samples(
        np.concatenate(points), np.concatenate(directions), np.concatenate(lengths), np.array(owner, dtype=np.int64)
    )


def _nearest(places: _Samples, stems: Sequence[Capsule], chunk: int = 2000) -> tuple[Array, npt.NDArray[np.int64]]:
    """Distance (n,) of each place to the nearest axis it lies by, inf where there is none, and that stem's index."""
    distance, index = np.full(len(places.points), np.inf), np.zeros(len(places.points), dtype=np.int64)
    if not stems:
        return distance, index
    starts, ends = np.array([stem.start for stem in stems]), np.array([stem.end for stem in stems])
    along = (ends - starts) / np.maximum(np.linalg.norm(ends - starts, axis=1, keepdims=True), 1e-12)
    for first in range(0, len(places.points), chunk):
        rows = slice(first, first + chunk)
        apart = places.points[rows, None] - closest_on_segments(places.points[rows], starts, ends)
        gap = np.linalg.norm(apart, axis=-1)
        turned = np.abs(places.directions[rows] @ along.T) < np.cos(AXIS_ANGLE)
        gap[turned | (gap > AXIS_DISTANCE)] = np.inf
        index[rows] = gap.argmin(axis=1)
        distance[rows] = gap.min(axis=1)
    return distance, index
