from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.crop import Stem
from greenhouse_gym.geometry import Array, rotation_about


@pytest.fixture
def real(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The benchmark's module."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    import shapes_real

    return shapes_real


def half_can(radius: float = 0.035) -> Array:
    """The visible half of an upright can at (0.7, 0, 0), 12 cm high, with a millimetre of noise."""
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(np.pi / 2, 3 * np.pi / 2, 3000), rng.uniform(0.0, 0.12, 3000)
    r = radius + rng.normal(0, 0.001, 3000)
    return np.column_stack([0.7 + r * np.cos(angle), r * np.sin(angle), height])


def upright(radius: float = 0.035, tilt: float = 0.0) -> Stem:
    middle = np.array([0.7, 0.0, 0.06])
    half = rotation_about([1, 0, 0], tilt) @ [0.0, 0.0, 0.06]
    return Stem(middle - half, middle + half, radius, "main")


def test_a_cylinder_is_fitted_to_one_side_of_it(real: Any) -> None:
    can = real.fit_cylinder(half_can())
    assert can.radius == pytest.approx(0.035, abs=5e-4)
    assert abs(real.direction(can)[2]) > 0.999
    np.testing.assert_allclose(can.start[:2], [0.7, 0.0], atol=1e-3)
    assert can.length == pytest.approx(0.12, abs=0.003)


def test_a_can_is_measured_by_the_stem_that_explains_it(real: Any) -> None:
    elsewhere = Stem([0, 0, 0], [0, 0, 1], 0.01, "main")
    right = real.measure_can(half_can(), [elsewhere, upright()])
    assert right["found"]
    assert right["radius_residual"] < 0.001
    assert right["axis_angle"] < 0.02
    assert real.measure_can(half_can(), [upright(0.040)])["radius_residual"] == pytest.approx(0.005, abs=5e-4)
    assert real.measure_can(half_can(), [upright(tilt=0.1)])["axis_angle"] == pytest.approx(0.1, abs=0.01)
    assert not real.measure_can(half_can(), [elsewhere])["found"]
    assert not real.measure_can(half_can(), [])["found"]


def test_false_length_is_what_lies_away_from_labelled_points(real: Any) -> None:
    points = half_can()
    assert real.false_length([upright()], points) == 0.0
    assert real.false_length([Stem([0, 0, 0], [0, 0, 0.12], 0.01, "main"), upright()], points) == pytest.approx(0.5)
    assert np.isnan(real.false_length([], points))
