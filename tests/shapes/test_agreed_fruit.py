"""What several looks agree upon: means of confidence, one fruit in each place, whatever the order of the looks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from greenhouse_gym.shapes.agreement import Find, agreed
from greenhouse_gym.shapes.spheres import SphereFit, all_apart

LEAST = 0.3


def find(y: float, confidence: float, radius: float = 0.02, ripeness: float = 0.0) -> Find:
    ball = SphereFit(np.array([0.5, y, 1.2]), radius, np.zeros(0, dtype=np.int64), 0.3, 0.001, 0.9)
    return Find(ball, confidence, ripeness)


def test_one_look_is_believed_as_it_is() -> None:
    look = [find(0.0, 0.9), find(0.1, 0.31), find(0.2, 0.29), find(0.005, 0.8)]
    assert [(f.ball.center[1], f.confidence) for f in agreed([look], LEAST)] == [(0.0, 0.9), (0.1, 0.31)]
    assert agreed([[]], LEAST) == agreed([[], []], LEAST) == []


def test_what_both_looks_see_is_as_credible_as_in_the_mean_and_stands_where_the_surer_one_sees_it() -> None:
    (found,) = agreed([[find(0.0, 0.4, ripeness=0.1)], [find(0.004, 0.8, 0.021, ripeness=0.7)]], LEAST)
    assert found.confidence == pytest.approx(0.6)
    assert (found.ball.center[1], found.ball.radius, found.ripeness) == (0.004, 0.021, 0.7)


def test_what_one_look_alone_sees_must_be_seen_well() -> None:
    assert agreed([[find(0.0, 0.5)], []], LEAST) == []
    (found,) = agreed([[], [find(0.0, 0.9)]], LEAST)
    assert 0.45 < found.confidence < 0.5
    assert agreed([[find(0.0, 0.9)], [], []], LEAST + 0.1) == []


def test_two_doubtful_looks_at_one_fruit_outweigh_a_single_sure_one_that_overlaps_both() -> None:
    looks = [[find(0.0, 0.55), find(0.05, 0.7)], [find(0.001, 0.55), find(0.05, 0.7)]]
    assert [round(f.ball.center[1], 2) for f in agreed(looks, LEAST)] == [0.05, 0.0]
    ends = agreed([[find(0.0, 0.4)], [find(0.025, 0.41)]], LEAST)
    assert len(ends) == 1, "the two ends of a long fruit, each seen by one look, are one"
    assert ends[0].confidence == pytest.approx(0.405)


confidences = st.floats(0.1, 1.0).map(lambda value: round(value, 6))
looks_of_fruit = st.lists(
    st.lists(st.tuples(st.floats(0.0, 0.3), confidences, st.floats(0.005, 0.03)), max_size=8), min_size=1, max_size=3
)


@given(looks_of_fruit)
def test_whatever_was_seen_is_apart_credible_and_of_no_look_before_another(looks: list) -> None:
    known: set[float] = set()
    finds = []
    for look in looks:  # no two alike: ties are broken by the order
        fresh = [one for one in look if not (one[1] in known or known.add(one[1]))]
        finds.append([find(*one) for one in fresh])
    found = agreed(finds, LEAST)
    assert all(f.confidence >= LEAST for f in found)
    assert [f.confidence for f in found] == sorted((f.confidence for f in found), reverse=True)
    for k, one in enumerate(found):
        assert all_apart(one.ball, [other.ball for other in found[:k]])
        assert one.confidence <= max(f.confidence for look in finds for f in look)
    again = agreed(finds[::-1], LEAST)
    assert {f.ball.center[1] for f in again} == {f.ball.center[1] for f in found} or len(finds) > 2
