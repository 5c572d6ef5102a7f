from __future__ import annotations

import numpy as np
import pytest
from row_helpers import grown

from greenhouse_gym.capture import D435_DEPTH, SEED_RIG, StereoNoise, sense_depth
from greenhouse_gym.capture.raycast import RowRaycaster
from greenhouse_gym.capture.sensor import draw_biases

FX = 424.2
FULL = StereoNoise()
SILENT = StereoNoise(disparity_noise=0.0, disparity_step=0.0, bias=0.0, dropout=0.0, edge_dropout=0.0, edge_fattening=0)


def wall(depth: float, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    return np.full(shape, depth)


def sense(depth: np.ndarray, noise: StereoNoise = FULL, bias: float = 0.0, seed: int = 0) -> np.ndarray:
    return sense_depth(depth, FX, np.random.default_rng(seed), noise, bias)


def step_image(near: float = 0.5, far: float = 1.0) -> np.ndarray:
    """A near block in the middle of a far wall."""
    depth = wall(far)
    depth[80:160, 120:200] = near
    return depth


@pytest.mark.parametrize(("depth", "sigma"), [(0.5, 0.00094), (0.35, 0.00046), (1.0, 0.0038)])
def test_spread_is_the_documented_one(depth: float, sigma: float) -> None:
    measured = sense(wall(depth))
    valid = measured[measured > 0].astype(float)
    assert valid.std() == pytest.approx(sigma, rel=0.4)
    assert valid.mean() == pytest.approx(depth, rel=0.002)


def test_neighbors_share_part_of_the_noise() -> None:
    noise = StereoNoise(dropout=0.0, edge_dropout=0.0)
    error = sense(wall(0.5), noise)[:, 60:] - 0.5
    beside = np.corrcoef(error[:, 1:].ravel(), error[:, :-1].ravel())[0, 1]
    apart = np.corrcoef(error[:, 8:].ravel(), error[:, :-8].ravel())[0, 1]
    assert 0.4 < beside < 0.9
    assert abs(apart) < 0.05


def test_with_every_term_off_only_the_depth_unit_is_left() -> None:
    depth = wall(0.5) + np.linspace(0.0, 0.01, 320)  # a slanted wall
    measured = sense(depth, SILENT)
    valid = measured > 0
    assert valid[:, 60:].all()
    np.testing.assert_allclose(measured[valid], depth[valid], atol=0.5e-3 + 1e-6)
    np.testing.assert_allclose(measured[valid] * 1000, np.rint(measured[valid] * 1000), atol=1e-4)
    exact = sense(depth, StereoNoise(**{**vars(SILENT), "depth_unit": 0.0}))
    np.testing.assert_allclose(exact[valid], depth[valid], rtol=1e-6)


def test_disparity_steps_bound_the_error() -> None:
    noise = StereoNoise(**{**vars(SILENT), "disparity_step": 1 / 32, "depth_unit": 0.0})
    depth = wall(1.0) + np.linspace(0.0, 0.2, 320)
    measured = sense(depth, noise)
    valid = measured > 0
    bound = depth**2 / (FX * noise.baseline) / 64 * 1.05
    assert (np.abs(measured - depth)[valid] <= bound[valid] + 1e-6).all()
    assert len(np.unique(measured[valid])) < 150  # steps show


def test_a_bias_scales_the_depth() -> None:
    plain, biased = sense(wall(0.5), SILENT), sense(wall(0.5), SILENT, bias=0.01)
    assert biased.max() == pytest.approx(0.505, abs=1e-6)
    np.testing.assert_array_equal(plain > 0, biased > 0)
    drawn = draw_biases(4000, np.random.default_rng(0), StereoNoise().bias)
    assert drawn.std() == pytest.approx(0.002, rel=0.05)
    assert abs(drawn.mean()) < 2e-4
    assert not draw_biases(3, np.random.default_rng(0), SILENT.bias).any()


def test_what_the_right_imager_does_not_see_is_missing_left_of_near_things() -> None:
    """The right imager sees around the near block on its right side, so the shadow falls on its left in the image."""
    missing = sense(step_image(), SILENT) == 0
    band = round(FX * SILENT.baseline * (1 / 0.5 - 1 / 1.0))
    row = missing[120]
    assert row[120 - band + 1 : 120].all()
    assert not row[120 : 320 - 1].any()  # neither the block nor what is right of it
    assert not row[60 : 120 - band - 1].any()
    assert not missing[40, 60:].any()  # above the block nothing is hidden


def test_the_left_border_is_outside_the_right_image() -> None:
    missing = sense(wall(1.0), SILENT) == 0
    border = FX * SILENT.baseline / 1.0
    assert missing[:, : int(border)].all()
    assert not missing[:, int(border) + 1 :].any()


def test_near_things_grow_over_far_ones() -> None:
    for edge_fattening in (0, 1, 3):
        noise = StereoNoise(**{**vars(SILENT), "edge_fattening": edge_fattening})
        measured = sense(step_image(), noise)
        near = np.flatnonzero((measured[120] > 0) & (measured[120] < 0.6))
        assert (near.min(), near.max()) == (120 - edge_fattening, 199 + edge_fattening)


def test_pixels_are_missing_mostly_at_edges() -> None:
    noise = StereoNoise(**{**vars(SILENT), "dropout": 0.02, "edge_dropout": 0.35})
    missing = sense(step_image(), noise) == 0
    assert missing[:, 198:202][85:155].mean() == pytest.approx(0.35, abs=0.06)
    assert missing[5:70, 60:].mean() == pytest.approx(0.02, abs=0.006)


@pytest.mark.parametrize(
    ("depth", "seen"), [(0.16, False), (0.18, True), (2.9, True), (3.1, False), (np.inf, False), (0.0, False)]
)
def test_the_range_is_limited(depth: float, seen: bool) -> None:
    assert (sense(wall(depth), SILENT)[:, 200:] > 0).all() == seen


def test_an_empty_image_stays_empty() -> None:
    assert not sense(wall(np.inf)).any()
    assert not sense(np.where(np.arange(320) < 0, 1.0, np.nan) * wall(1.0)).any()


def test_same_seed_same_noise() -> None:
    np.testing.assert_array_equal(sense(step_image(), seed=3), sense(step_image(), seed=3))
    assert (sense(step_image(), seed=3) != sense(step_image(), seed=4)).any()


def test_share_of_holes_in_the_foreground_of_a_row() -> None:
    """Away from the invalid band at the left border, which the test above measures."""
    band = round(D435_DEPTH.fx * StereoNoise().baseline / 0.4)
    caster = RowRaycaster.of(grown())
    for camera in SEED_RIG.cameras.values():
        for along in (0.1, 0.4):
            pose = np.eye(4)
            pose[1, 3] = along
            true = caster.render(pose @ camera.rig_from_camera, D435_DEPTH).depth
            measured = sense_depth(true, D435_DEPTH.fx, np.random.default_rng(0))
            foreground = true < 0.6
            foreground[:, :band] = False
            assert foreground.mean() > 0.05
            assert 0.04 < (measured[foreground] == 0).mean() < 0.20
