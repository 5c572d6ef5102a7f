"""Compare found stems with true ones by length: recall, false length, and errors of axes and radii."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.accuracy.tomatoes import fraction
from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.geometry import Array, Capsule, closest_on_segments

AXIS_DISTANCE = 0.010
"""Largest distance between two axes that count as the same stem, metres."""

AXIS_ANGLE = float(np.deg2rad(30.0))
"""Largest angle between two such axes, radians."""

_CHUNK = 2000  # samples handled at a time
SPACING = 0.005
"""Largest length of axis that one sample represents, metres."""


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
        radius_error: (k,) relative, unsigned, at the same samples.
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
        """Fraction of the visible length that matches a found stem of any kind."""
        return fraction(self.found, self.visible)

    @property
    def recall_as_such(self) -> float:
        """Fraction of the visible length that matches a found stem of the same kind."""
        return fraction(self.found_as_such, self.visible)

    @property
    def false_fraction(self) -> float:
        """Fraction of the extracted length that matches no true stem."""
        return fraction(self.false, self.extracted)


class _Samples(NamedTuple):
    points: Array  # (n, 3)
    directions: Array  # (n, 3) unit vectors
    lengths: Array  # (n,) metres each stands for
    owner: npt.NDArray[np.int64]  # (n,) index of the stem


def compare_stems(
    true: Sequence[Stem], visible: Sequence[Stem], others: Sequence[Capsule], found: Sequence[Stem], kind: str
) -> StemComparison:
    """Compare the stems of one kind with those found.

    A point of an axis lies by another axis that is within `AXIS_DISTANCE` of it and runs within `AXIS_ANGLE` there.

    Args:
        true: All stems of the row, of every kind.
        visible: The stems, or parts of stems, that were visible.
        others: Capsules of the row that are not stems: the petioles of leaves.
        found: Stems found, in the frame of the true ones.
        kind: The kind of interest.
    """
    wanted = [stem for stem in visible if stem.kind == kind]
    named = [stem for stem in found if stem.kind == kind]
    samples, claimed = _samples(wanted), _samples(named)
    any_kind, _ = _nearest(samples, found)
    distance, index = _nearest(samples, named)
    as_such = np.isfinite(distance)
    radii = np.array([stem.radius for stem in named])
    true_radii = np.array([stem.radius for stem in wanted])
    false = ~np.isfinite(_nearest(claimed, true)[0])
    on_petioles = false & np.isfinite(_nearest(claimed, others)[0])
    return StemComparison(
        visible=float(samples.lengths.sum()),
        found=float(samples.lengths[np.isfinite(any_kind)].sum()),
        found_as_such=float(samples.lengths[as_such].sum()),
        extracted=float(claimed.lengths.sum()),
        false=float(claimed.lengths[false].sum()),
        on_petioles=float(claimed.lengths[on_petioles].sum()),
        axis_error=distance[as_such],
        radius_error=np.abs(radii[index[as_such]] / true_radii[samples.owner[as_such]] - 1.0),
    )


def pool_stems(comparisons: Sequence[StemComparison]) -> StemComparison:
    """Pool the comparisons of several rows or kinds."""
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
    """Sample the axes at the centers of equal parts of at most `SPACING`; a ball has no samples."""
    points, directions, lengths, owner = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)], []
    for index, stem in enumerate(stems):
        if stem.length < 1e-6:
            continue
        count = int(np.ceil(stem.length / SPACING))
        fractions = (np.arange(count) + 0.5) / count
        points.append(stem.start + fractions[:, None] * (stem.end - stem.start))
        directions.append(np.tile((stem.end - stem.start) / stem.length, (count, 1)))
        lengths.append(np.full(count, stem.length / count))
        owner += [index] * count
    return _Samples(
        np.concatenate(points), np.concatenate(directions), np.concatenate(lengths), np.array(owner, dtype=np.int64)
    )


def _nearest(samples: _Samples, stems: Sequence[Capsule]) -> tuple[Array, npt.NDArray[np.int64]]:
    """Return the distance (n,) of each sample to the nearest matching axis (inf without one), and its index."""
    distance, index = np.full(len(samples.points), np.inf), np.zeros(len(samples.points), dtype=np.int64)
    if not stems:
        return distance, index
    starts, ends = np.array([stem.start for stem in stems]), np.array([stem.end for stem in stems])
    along = (ends - starts) / np.maximum(np.linalg.norm(ends - starts, axis=1, keepdims=True), 1e-12)
    for first in range(0, len(samples.points), _CHUNK):
        rows = slice(first, first + _CHUNK)
        apart = samples.points[rows, None] - closest_on_segments(samples.points[rows], starts, ends)
        gap = np.linalg.norm(apart, axis=-1)
        turned = np.abs(samples.directions[rows] @ along.T) < np.cos(AXIS_ANGLE)
        gap[turned | (gap > AXIS_DISTANCE)] = np.inf
        index[rows] = gap.argmin(axis=1)
        distance[rows] = gap.min(axis=1)
    return distance, index
