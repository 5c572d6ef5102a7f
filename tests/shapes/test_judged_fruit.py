"""Who judges large fruit, a regression and a network beside it, and what must bend to be one."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.shapes import ShapeSettings, tomatoes
from greenhouse_gym.shapes.candidates import COMPANY, MEASURES, MOST_CONTRAST
from greenhouse_gym.shapes.credibility import ALONE, BESIDE, IN_ROW, Judges, credibility, judged, shipped_judges
from greenhouse_gym.shapes.spheres import SphereFit
from greenhouse_gym.shapes.surfaces import SurfaceCloud
from greenhouse_gym.shapes.surroundings import SURROUNDINGS
from greenhouse_gym.shapes.tomatoes import Looks, large_tomatoes

COLUMNS = len(MEASURES) + len(COMPANY) + len(SURROUNDINGS)


def constant(value: float):
    return lambda measures: np.full(len(measures), value)


def looks(**measured: float) -> Looks:
    """A sphere of the first look with some measures, and none of the second."""
    points = np.zeros((40, 3))
    cloud = SurfaceCloud(points, points, points, np.zeros((40, 2)), np.zeros(40), np.zeros(40), -0.15, 0.02)
    ball = SphereFit(np.array([0.5, 0.0, 1.2]), 0.02, np.arange(40), 0.3, 0.001, 0.9)
    first = np.zeros((1, COLUMNS))
    for name, value in measured.items():
        first[0, [*MEASURES, *COMPANY].index(name.replace("_", " "))] = value
    return Looks(cloud, [ball], first, [], np.zeros((0, COLUMNS)))


def test_a_network_counts_as_much_as_a_regression() -> None:
    measures = np.random.default_rng(0).normal(size=(5, COLUMNS))
    alone = credibility(measures[:, : len(IN_ROW) - 1], IN_ROW)
    np.testing.assert_allclose(judged(measures, IN_ROW, constant(0.5)), alone / 2 + 0.25)


def test_the_regressions_are_of_the_first_measures() -> None:
    assert len(ALONE) - 1 == len(MEASURES)
    assert len(IN_ROW) == len(BESIDE) == len(MEASURES) + len(COMPANY) + 1


@pytest.mark.parametrize("judge", shipped_judges())
def test_shipped_networks_judge_all_measures(judge) -> None:
    likely = judge(np.random.default_rng(0).normal(size=(7, COLUMNS)))
    assert likely.shape == (7,)
    assert ((likely >= 0) & (likely <= 1)).all()
    assert np.ptp(likely) > 0


def test_the_judges_are_asked() -> None:
    settings = ShapeSettings(min_confidence=0.0)
    one = looks(neighbors=1.0)
    regression = credibility(one.first[:, : len(IN_ROW) - 1], IN_ROW)
    found = large_tomatoes(one, settings, Judges(constant(1.0), refuses_none))
    np.testing.assert_allclose(found.confidence, (regression + 1) / 2)


def refuses_none(measures: np.ndarray) -> np.ndarray:
    assert not len(measures), "the second look has found nothing"
    return np.zeros(0)


@pytest.mark.parametrize(
    ("contrast", "credible", "neighbors", "bend", "kept"),
    [
        (MOST_CONTRAST, 0.9, 0.0, 0.0, True),  # red and sure: however little of it shows
        (MOST_CONTRAST, 0.7, 0.0, 0.0, False),  # red, but not sure
        (0.1, 0.99, 0.0, 0.0, False),  # as green as a leaf, and no more bent
        (0.1, 0.5, 0.0, 1.0, True),  # bent like a ball
        (0.1, 0.5, 1.0, 0.0, True),  # in company
    ],
)
def test_what_hangs_alone_is_bent_or_red(
    monkeypatch: pytest.MonkeyPatch, contrast: float, credible: float, neighbors: float, bend: float, kept: bool
) -> None:
    monkeypatch.setattr(tomatoes, "judged", lambda measures, *_: np.full(len(measures), credible))
    one = looks(contrast=contrast, neighbors=neighbors, smaller_bend=bend)
    one.first[0, MEASURES.index("patch's smaller bend")] = bend
    assert (len(large_tomatoes(one, ShapeSettings()).fits) == 1) == kept
