from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greenhouse_gym.capture import StereoDropout, StereoNoise, sense_depth
from greenhouse_gym.capture.light import Light, Skin, draw_light, shade
from greenhouse_gym.capture.raycast import RowRaycaster
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.capture.sensor import dropout_probability, mix_edges
from greenhouse_gym.crops import Organ, PlantRow
from greenhouse_gym.crops.organs import tube_organ
from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.geometry import pose
from greenhouse_gym.geometry.point_clouds import exposure_failure

LEAF = np.array([[0.25, 0.42, 0.10]])
NOON = Light(elevation=np.pi / 2, sun=1.0, diffuse=0.5, gloss=0.0)


def lit(light: Light, normal_z: float, sunlit: bool = True, thin: bool = True, shine: float = 0.0) -> np.ndarray:
    """A level leaf seen from below by a camera, its upper side up or down."""
    corners = np.array([[0, 1, 2]])
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    skin = Skin.of(vertices, corners, LEAF, np.array([thin]), np.array([shine], dtype=np.float32))
    normal = np.array([[0.0, 0.0, normal_z]], dtype=np.float32)
    color, _ = shade(
        skin, light, np.array([0]), normal, np.array([[0.0, 0.0, 1.0]], dtype=np.float32), np.array([sunlit])
    )
    return color[0]


def redness(color: np.ndarray) -> float:
    return float((color[0] - color[1]) / (color[0] + color[1]))


def test_light_comes_through_a_leaf_and_not_through_a_fruit() -> None:
    through, blocked = lit(NOON, 1.0), lit(NOON, 1.0, thin=False)
    assert through.sum() > 1.2 * blocked.sum()
    assert redness(through) < redness(lit(NOON, 1.0, sunlit=False)) - 0.01


def test_the_lower_side_of_a_leaf_is_paler() -> None:
    shadow = replace(NOON, sun=0.0)
    upper, lower = lit(shadow, -1.0), lit(shadow, 1.0)
    assert lower.sum() > upper.sum()
    assert abs(redness(lower)) < abs(redness(upper))


def test_exposure_and_white_balance_act_on_every_channel() -> None:
    plain = lit(NOON, -1.0)
    assert (lit(replace(NOON, exposure=2.0), -1.0) > plain).all()
    warm = lit(replace(NOON, white_balance=(1.3, 1.0, 0.8)), -1.0)
    assert warm[0] > plain[0]
    assert warm[1] == plain[1]
    assert warm[2] < plain[2]


def test_drawn_light_follows_the_seed_and_differs_between_seeds() -> None:
    assert draw_light(np.random.default_rng(1)) == draw_light(np.random.default_rng(1))
    lights = [draw_light(np.random.default_rng(seed)) for seed in range(20)]
    assert np.std([light.azimuth for light in lights]) > 1.0
    assert np.std([light.white_balance[2] for light in lights]) > 0.03


def bare_stem() -> PlantRow:
    """A thick pole of organs, and a leaf that shades its middle."""
    pole = tube_organ("main", np.array([[0.5, 0.0, z, 0.02] for z in np.linspace(0.5, 1.5, 11)]), (0.4, 0.5, 0.3))
    vertices = np.array([[0.3, -0.1, 1.2], [0.5, -0.1, 1.2], [0.5, 0.1, 1.2], [0.3, 0.1, 1.2]])
    leaf = Organ("leaf", vertices, np.array([[0, 1, 2], [0, 2, 3]]), np.tile([0.2, 0.4, 0.1], (2, 1)))
    stem = Stem(np.array([0.5, 0.0, 0.5]), np.array([0.5, 0.0, 1.5]), 0.02, kind="main")
    return PlantRow((), (stem,), (), 1.0, 0, organs=(pole, leaf))


def test_a_leaf_throws_its_shadow_and_triangles_know_their_shape() -> None:
    light = Light(azimuth=np.pi, elevation=1.0, sun=1.0, diffuse=0.5, gloss=0.0)
    caster = RowRaycaster.of(bare_stem(), light)
    level = np.column_stack([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    view = caster.render(pose(level, np.array([0.0, 0.0, 1.0])), Intrinsics(320, 240, 200.0, 200.0, 159.5, 119.5))
    column = view.color[:, 160].astype(int).sum(axis=1)
    on_stem = view.shape[:, 160] == 0
    # the sun comes down on the aisle's side: the leaf at 1.2 m shades what lies below it, not the foot of the pole
    assert on_stem[60:].all()
    assert column[75:85].mean() < 0.9 * column[200:230].mean()
    assert set(np.unique(view.shape)) == {-1, 0, 1}


def test_thin_things_lose_depth_and_thick_ones_do_not() -> None:
    depth = np.full((100, 200), 1.5)
    depth[:, 50:53] = depth[:, 120:160] = 0.5
    lost = dropout_probability(depth, np.full((100, 200, 3), 100, dtype=np.uint8), np.zeros(depth.shape), 424.2)
    assert (lost[:, 50:53] > 0).all()
    assert not lost[:, 53:].any()
    assert not lost[:, :50].any()


def test_glare_and_bad_exposure_lose_depth() -> None:
    color, glare = np.full((4, 4, 3), 100, dtype=np.uint8), np.zeros((4, 4))
    color[0], color[1], glare[2] = 255, 0, 0.5
    lost = dropout_probability(np.full((4, 4), 0.5), color, glare, 424.2)
    assert (lost[:3] > 0.4).all()
    assert not lost[3].any()


def test_mixed_pixels_lie_between_near_and_far() -> None:
    depth = np.full((100, 100), 1.0)
    depth[:, 50:] = 0.5
    mixed = mix_edges(depth, np.random.default_rng(0), 0.5)
    changed = mixed != depth
    assert 30 < changed.sum() < 70
    assert ((mixed[changed] > 0.5) & (mixed[changed] < 1.0)).all()
    assert np.array_equal(mix_edges(depth, np.random.default_rng(0), 0.0), depth)


def test_without_doubt_the_sensor_is_the_old_one() -> None:
    depth = np.random.default_rng(3).uniform(0.4, 0.8, (60, 80))
    old, new = (
        sense_depth(depth, 424.2, np.random.default_rng(5), StereoNoise(), dropout=lost)
        for lost in (0.0, np.zeros((60, 80)))
    )
    assert np.array_equal(old, new)
    assert StereoDropout().thin_dropout > 0


@pytest.mark.parametrize(("level", "message"), [(0.0, "underexposed"), (1.0, "overexposed"), (0.5, "")])
def test_exposures_that_fail_are_reported(level: float, message: str) -> None:
    assert exposure_failure(np.full((100, 3), level)).endswith(message)
    assert bool(exposure_failure(np.full((100, 3), level))) == bool(message)
