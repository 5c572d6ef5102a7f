from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.crops.parts import STEM_KINDS, Stem, Tomato
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.geometry import Ellipsoid, Sphere, distance_to_shapes, rotation_about

AXES = np.array([0.02, 0.025, 0.03])
TURN = rotation_about([1.0, 2.0, 3.0], 0.7)


def oblate(center: list[float]) -> Tomato:
    return Tomato(Ellipsoid(center, AXES, TURN), truss=0)


def test_a_tomato_may_be_an_ellipsoid_and_distances_say_so() -> None:
    tomato, ball = oblate([0.1, 0.2, 0.3]), Tomato(Sphere([0.1, 0.2, 0.3], 0.025), truss=1)
    capsule = Stem([0, 0, 0], [0, 0, 2], 0.01, kind="main")
    points = tomato.center + np.array([0.1 * TURN[:, 0], 0.1 * TURN[:, 2]])
    found = distance_to_shapes(points, [capsule, tomato.shape, ball.shape])
    np.testing.assert_allclose(found[:, 1], [0.08, 0.07], atol=1e-7)
    np.testing.assert_allclose(found[:, 2], 0.075, atol=1e-7)


def test_an_ellipsoid_has_the_radius_of_its_volume() -> None:
    assert Ellipsoid([0, 0, 0], AXES, TURN).radius == pytest.approx(0.024662, abs=1e-6)
    assert Ellipsoid([0, 0, 0], AXES, TURN, 0.0247).radius == 0.0247
    for radius in (0.03, -0.0247, np.nan):
        with pytest.raises(InvalidValueError, match=r"radius.*0\.0246"):
            Ellipsoid([0, 0, 0], AXES, TURN, radius)


def test_a_tomato_has_a_shape_and_a_truss() -> None:
    tomato = Tomato(Sphere([0.1, 0.2, 0.3], 0.03), truss=4, ripeness=0.5)
    np.testing.assert_array_equal(tomato.center, [0.1, 0.2, 0.3])
    assert (tomato.radius, tomato.truss, tomato.ripeness) == (0.03, 4, 0.5)
    assert Tomato(Sphere([0, 0, 0], 0.03), truss=0).ripeness is None


@pytest.mark.parametrize("ripeness", [-0.01, 1.01, np.nan])
def test_ripeness_lies_between_zero_and_one(ripeness: float) -> None:
    with pytest.raises(InvalidValueError, match="ripeness"):
        Tomato(Sphere([0, 0, 0], 0.03), truss=0, ripeness=ripeness)


@pytest.mark.parametrize("kind", STEM_KINDS)
def test_every_kind_of_stem(kind: str) -> None:
    stem = Stem([0, 0, 0], [0, 0, 2], 0.01, kind=kind)  # type: ignore[arg-type]
    assert stem.kind == kind
    assert stem.length == 2.0


def test_an_unknown_kind_lists_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match=r"'mian'.*Did you mean 'main'.*peduncle"):
        Stem([0, 0, 0], [0, 0, 2], 0.01, kind="mian")  # type: ignore[arg-type]


def test_the_checks_of_the_shapes_hold() -> None:
    with pytest.raises(InvalidValueError, match="radius"):
        Tomato(Sphere([0, 0, 0], -0.03), truss=0)
    with pytest.raises(InvalidValueError, match="finite"):
        Stem([0, 0, np.nan], [0, 0, 2], 0.01, kind="main")
