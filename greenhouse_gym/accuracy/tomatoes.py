"""Compare found tomatoes with true ones: counts and errors by ripeness and visible fraction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from greenhouse_gym.accuracy.visibility import Visibility
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Array


def fraction(part: float, whole: float) -> float:
    """Return ``part / whole``, or NaN where ``whole`` is 0."""
    return part / whole if whole else float("nan")


class Matches(NamedTuple):
    """Pairs of true and found tomatoes whose centers lie within one true radius.

    Attributes:
        true: (k,) indices of true tomatoes.
        found: (k,) indices of found ones.
        center_errors: (k,) metres.
        diameter_errors: (k,) relative.
    """

    true: npt.NDArray[np.int64]
    found: npt.NDArray[np.int64]
    center_errors: Array
    diameter_errors: Array


def match_tomatoes(true: Sequence[Tomato], found: Sequence[Tomato]) -> Matches:
    """Match tomatoes one to one with the least total distance; a tomato without a partner costs its radius.

    Pairs are therefore never farther apart than a true radius, and never replace a nearer pair.
    """
    if not true or not found:
        empty = np.zeros(0, dtype=np.int64)
        return Matches(empty, empty, np.zeros(0), np.zeros(0))
    a, b = np.array([t.center for t in true]), np.array([t.center for t in found])
    radii, sizes = np.array([t.radius for t in true]), np.array([t.radius for t in found])
    distance = np.linalg.norm(a[:, None] - b[None], axis=-1)
    i, j = linear_sum_assignment(np.minimum(distance - radii[:, None], 0.0))
    close = distance[i, j] < radii[i]
    i, j = i[close], j[close]
    return Matches(i, j, distance[i, j], np.abs(sizes[j] / radii[i] - 1.0))


RIPENESS_BANDS = {"green": (0.0, 1 / 3), "turning": (1 / 3, 2 / 3), "ripe": (2 / 3, np.inf)}
"""Named ranges of ripeness, lower bound included, upper bound excluded."""

OCCLUSION_BANDS = {"cut off": (0.0, 0.3), "half hidden": (0.3, 0.6), "partly hidden": (0.6, 0.9), "free": (0.9, np.inf)}
"""Named ranges of the visible fraction of a tomato's silhouette, lower bound included, upper bound excluded; less than
0.3 of a fruit cut off by the edge of the image is visible."""


@dataclass(frozen=True, eq=False)
class TomatoComparison:
    """Visible tomatoes of one row or several, compared with those found.

    Attributes:
        ripeness: (n,) true ripeness of the visible tomatoes.
        visible_fraction: (n,) fraction of their silhouette that was visible (`Visibility.whole`).
        center_error: (n,) metres; NaN where a tomato was missed.
        diameter_error: (n,) relative, unsigned; NaN where a tomato was missed.
        false: (m,) ripeness of found tomatoes without a true one; NaN where unknown.
        truss_right: (k,) for each truss with a visible tomato, whether one found truss holds exactly its visible ones.
    """

    ripeness: Array
    visible_fraction: Array
    center_error: Array
    diameter_error: Array
    false: Array
    truss_right: npt.NDArray[np.bool_]

    @property
    def found(self) -> npt.NDArray[np.bool_]:
        """(n,) mask of the visible tomatoes that were found."""
        return np.isfinite(self.center_error)

    @property
    def recall(self) -> float:
        """Fraction of the visible tomatoes that were found."""
        return fraction(int(np.count_nonzero(self.found)), len(self.found))

    @property
    def precision(self) -> float:
        """Fraction of the found tomatoes that are true; those that match a hidden tomato are not counted."""
        true = int(np.count_nonzero(self.found))
        return fraction(true, true + len(self.false))

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        true = int(np.count_nonzero(self.found))
        return fraction(2 * true, len(self.found) + true + len(self.false))

    def of_ripeness(self, low: float, high: float) -> TomatoComparison:
        """Return the tomatoes with ``low <= ripeness < high``, true and false, without trusses."""
        claimed = (self.false >= low) & (self.false < high)
        return self._select((self.ripeness >= low) & (self.ripeness < high), self.false[claimed])

    def of_visible_fraction(self, low: float, high: float) -> TomatoComparison:
        """Return the tomatoes whose visible fraction lies in a range, without false ones and trusses."""
        return self._select((self.visible_fraction >= low) & (self.visible_fraction < high), np.zeros(0))

    def _select(self, rows: npt.NDArray[np.bool_], false: Array) -> TomatoComparison:
        return TomatoComparison(
            self.ripeness[rows],
            self.visible_fraction[rows],
            self.center_error[rows],
            self.diameter_error[rows],
            false,
            np.zeros(0, dtype=bool),
        )


def compare_tomatoes(true: Sequence[Tomato], visibility: Visibility, found: Sequence[Tomato]) -> TomatoComparison:
    """Compare the visible tomatoes of a row with those found.

    Found tomatoes are matched to visible ones first. The rest is matched to hidden ones, which count neither as true
    nor as false.

    Args:
        true: All n tomatoes of the row.
        visibility: Visibility of each of them.
        found: The found tomatoes, in the frame of the true ones.
    """
    visible: npt.NDArray[np.int64] = np.flatnonzero(visibility.visible)
    hidden = np.flatnonzero(~visibility.visible)
    matches = match_tomatoes([true[i] for i in visible.tolist()], found)
    left = np.setdiff1d(np.arange(len(found)), matches.found)
    more = match_tomatoes([true[i] for i in hidden.tolist()], [found[j] for j in left.tolist()])
    partner = np.full(len(found), -1)
    partner[matches.found] = visible[matches.true]
    partner[left[more.found]] = hidden[more.true]
    center_error, diameter_error = np.full((2, len(visible)), np.nan)
    center_error[matches.true], diameter_error[matches.true] = matches.center_errors, matches.diameter_errors
    return TomatoComparison(
        np.array([_ripeness(true[i]) for i in visible.tolist()]).reshape(-1),
        visibility.whole[visible],
        center_error,
        diameter_error,
        np.array([_ripeness(found[j]) for j in np.flatnonzero(partner < 0).tolist()]).reshape(-1),
        _trusses_right(true, visibility.visible, found, partner),
    )


def pool_tomatoes(comparisons: Sequence[TomatoComparison]) -> TomatoComparison:
    """Pool the comparisons of several rows."""
    return TomatoComparison(
        *(np.concatenate([getattr(c, field.name) for c in comparisons]) for field in fields(TomatoComparison))
    )


def _trusses_right(
    true: Sequence[Tomato],
    visible: npt.NDArray[np.bool_],
    found: Sequence[Tomato],
    partner: npt.NDArray[np.int64],
) -> npt.NDArray[np.bool_]:
    """Return a mask of the trusses with visible tomatoes for which a found truss holds all of these and no others.

    Each found truss is matched one to one with the true truss with which it shares most visible tomatoes. Hidden
    tomatoes of the same truss may be found or not.
    """
    of_true, of_found = np.array([t.truss for t in true]), np.array([t.truss for t in found])
    trusses, named = np.unique(of_true[visible]), np.unique(of_found)
    shared = np.zeros((len(trusses), len(named)), dtype=int)
    for j in np.flatnonzero(partner >= 0):
        if visible[partner[j]]:
            shared[trusses == of_true[partner[j]], named == of_found[j]] += 1
    right = np.zeros(len(trusses), dtype=bool)
    for i, k in zip(*linear_sum_assignment(-shared), strict=True):
        own = partner[of_found == named[k]]
        stray = (own < 0) | (of_true[own] != trusses[i])
        right[i] = not stray.any() and shared[i, k] == np.count_nonzero(visible & (of_true == trusses[i]))
    return right


def _ripeness(tomato: Tomato) -> float:
    return np.nan if tomato.ripeness is None else tomato.ripeness
