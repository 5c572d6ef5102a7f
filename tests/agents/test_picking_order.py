"""Tours through fruit: 2-opt against every order, and which ways are planned for them."""

from itertools import pairwise, permutations
from types import SimpleNamespace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from greenhouse_gym.agents.harvest import picking_order
from greenhouse_gym.agents.harvest.picking_order import PickingOrder, short_tour


def length(tour, first, legs):
    return first[tour[0]] + sum(legs[i, j] for i, j in pairwise(tour))


def points(count):
    coordinates = st.floats(-1, 1, allow_nan=False, width=32)
    return arrays(np.float64, (count + 1, 2), elements=coordinates)


@given(st.integers(1, 6).flatmap(points))
@settings(deadline=None, max_examples=60)
def test_a_tour_visits_every_place_once_and_no_reversal_makes_it_shorter(places):
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    first, legs = apart[0, 1:], apart[1:, 1:]
    tour = short_tour(first, legs)
    assert sorted(tour) == list(range(len(first)))
    best = min(length(order, first, legs) for order in permutations(range(len(first))))
    assert best - 1e-9 <= length(tour, first, legs)
    for i in range(len(tour)):
        for j in range(i + 2, len(tour) + 1):
            other = [*tour[:i], *reversed(tour[i:j]), *tour[j:]]
            assert length(other, first, legs) >= length(tour, first, legs) - 1e-6


def test_a_tour_leaves_the_nearest_place_first_only_if_that_is_shorter():
    line = np.array([0.0, -1.0, 1.1, 5.0])  # from 0: the nearest first is there and back
    apart = np.abs(line[:, None] - line)
    assert short_tour(apart[0, 1:], apart[1:, 1:]) == [0, 1, 2]
    line = np.array([0.0, 1.0, -1.1, -0.9, 2.0])
    apart = np.abs(line[:, None] - line)
    assert short_tour(apart[0, 1:], apart[1:, 1:]) == [2, 1, 0, 3]
    assert short_tour(np.empty(0), np.empty((0, 0))) == []


def test_places_without_a_way_come_last():
    first, legs = np.array([30.0, 1.0, 2.0]), np.array([[0, 1, 1], [30, 0, 1], [30, 1, 0.0]])
    assert short_tour(first, legs) == [1, 2, 0]


def test_ways_from_above_the_crate_are_planned_once_and_those_from_here_each_time(monkeypatch):
    places = {4: 1.0, 7: 3.0, 9: -2.0}  # joint positions at fruit, radians; the crate is at 0
    planned = []

    def plan(scene, target, planner, robot, goals, seed, start, checks):
        end = places[target] if isinstance(goals, int) else 0.0
        planned.append((float(start[0]), end))
        return None if target == 9 and isinstance(goals, int) and start[0] > 2 else np.array([start, [end]])

    monkeypatch.setattr(picking_order, "pointing_down", lambda *given: np.zeros((1, 1)))
    here = SimpleNamespace(
        command=np.array([2.5]), chain=None, plan=plan, scene=lambda **options: (None, {k: k for k in places})
    )
    order = PickingOrder(None, "RRTConnect", 0)
    assert order.of(here, [4, 7, 9], np.zeros(3)) == [7, 4, 9]
    assert sorted(planned[:3]) == [(2.5, -2.0), (2.5, 1.0), (2.5, 3.0)]
    assert set(planned[3:5]) == {(1.0, 0.0), (3.0, 0.0)}, "to the crate, from fruit that a path leads to"
    above = {start for start, _ in planned[5:]}
    assert above == {0.0, 2.5}, "where there is no path to a fruit, from here"
    here.command, planned[:] = np.array([0.0]), []
    assert order.of(here, [4, 9], np.zeros(3)) == [4, 9]
    assert planned == [(0.0, 1.0), (0.0, -2.0)]
