"""Order of picking: a short tour through fruit, with a visit to the crate after every one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greenhouse_gym.agents.harvest.picking import pointing_down
from greenhouse_gym.agents.harvest.rehearsal import Rehearsal
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.path import path_length
from greenhouse_gym.robots import Robot

_GOALS, _CHECKS = 30, 10_000  # configurations at a fruit, and collision checks of a plan
_NO_PATH = 30.0  # radians: stands for the length of a path that is not found
_SAME = 0.5  # radians between configurations above the crate that count as one
_AROUND = 0.04  # metres: distance from the crate that paths keep


class PickingOrder:
    """Order of fruit by the lengths of planned paths.

    A fruit's own way to the crate is the same in any order. What depends on the order is the way to the next one, which
    begins above the crate, in the configuration nearest to the one at the fruit before. These ways are planned once;
    those from where the arm is are planned each time.

    Args:
        robot: The arm.
        planner: A name in `greenhouse_gym.planning.PLANNERS`.
        seed: Seed of the configurations above the crate.
    """

    def __init__(self, robot: Robot, planner: str, seed: int):
        self._robot, self._planner, self._seed = robot, planner, seed
        self._above: list[Array] = []
        self._next: list[dict[int, float]] = []  # lengths of the ways from above the crate, by fruit
        self._last: dict[int, int] = {}  # number of the configuration above the crate, by fruit

    def of(self, rehearsal: Rehearsal, fruit: Sequence[int], crate: Array) -> list[int]:
        """Return fruit in the order of a short tour.

        Args:
            rehearsal: The simulation as it is.
            fruit: Numbers of fruit that hang.
            crate: (3,) where fruit are let go, metres.
        """
        scene, tomatoes = rehearsal.scene(leaves=True, around_crate=_AROUND)

        def path_to(start: Array, k: int, goals: int | Array = _GOALS) -> Array | None:
            return rehearsal.plan(scene, tomatoes[k], self._planner, self._robot, goals, 0, start, _CHECKS)

        paths = {k: path_to(rehearsal.command, k) for k in fruit}
        if not self._last.keys() >= set(fruit):
            self._above, self._next, self._last = [], [], {}
            for k, path in paths.items():
                above = rehearsal.command
                if path is not None:
                    found = pointing_down(rehearsal.chain, self._robot, path[-1], crate, self._seed)
                    back = path_to(path[-1], k, found) if len(found) else None
                    above = above if back is None else back[-1]
                self._last[k] = self._numbered(above)
            self._next = [{k: _length_of(path_to(above, k)) for k in fruit} for above in self._above]
        legs = np.array([[self._next[self._last[i]][j] for j in fruit] for i in fruit])
        return [fruit[k] for k in short_tour(np.array([_length_of(paths[k]) for k in fruit]), legs)]

    def _numbered(self, above: Array) -> int:
        """Return the number of a configuration above the crate (j,), or of one like it."""
        for number, known in enumerate(self._above):
            if np.abs(known - above).max() < _SAME:
                return number
        self._above.append(above)
        return len(self._above) - 1


def _length_of(path: Array | None) -> float:
    return _NO_PATH if path is None else path_length(path)


def short_tour(first: Array, legs: Array) -> list[int]:
    """Return the order of n places in a tour that begins elsewhere and ends anywhere, improved by 2-opt.

    It begins with the nearest place each time, then reverses parts of the tour as long as that makes it shorter.

    Args:
        first: (n,) lengths of the ways from the beginning.
        legs: (n, n) lengths of the ways from places (rows) to others.
    """
    tour, left, lengths = [], list(range(len(first))), first
    while left:
        place = min(left, key=lambda k: (lengths[k], k))
        left.remove(place)
        tour.append(place)
        lengths = legs[place]
    length, shorter = _length(tour, first, legs), True
    while shorter:
        shorter = False
        for i in range(len(tour)):
            for j in range(i + 1, len(tour)):
                other = [*tour[:i], *reversed(tour[i : j + 1]), *tour[j + 1 :]]
                if (reversed_length := _length(other, first, legs)) < length - 1e-9:
                    tour, length, shorter = other, reversed_length, True
    return tour


def _length(tour: Sequence[int], first: Array, legs: Array) -> float:
    return float(first[tour[0]] + legs[tour[:-1], tour[1:]].sum()) if tour else 0.0
