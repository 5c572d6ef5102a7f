from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import distance_to_capsules
from greenhouse_gym.motion.path import CORNER_TOLERANCE
from greenhouse_gym.planning import (
    CollisionChecker,
    follow_path,
    free_commands,
    path_length,
    plan,
    planning_model,
    resample,
)
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import compile_scene

INTERVAL = 0.05
SPEED, ACCELERATION = np.array([1.6, 1.6, 0.8]), np.array([14.0, 14.0, 7.0])


def test_length() -> None:
    assert path_length([[0, 0], [3, 4], [3, 5]]) == 6.0
    assert path_length([[1.0, 2.0]]) == 0.0


def test_resampling_keeps_corners_and_the_step() -> None:
    path = np.array([[0.0, 0.0], [1.0, 0.1], [1.0, 0.15]])
    points = resample(path, 0.3)
    assert np.abs(np.diff(points, axis=0)).max() <= 0.3 + 1e-12
    for corner in path:
        assert (points == corner).all(-1).any()
    assert np.array_equal(resample(path[:1], 0.3), path[:1])


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 8), st.integers(0, 10_000))
def test_commands_stay_on_the_path_and_within_the_limits(corners: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = np.cumsum(rng.normal(scale=10 ** rng.uniform(-3, 0), size=(corners + 1, 3)), axis=0)
    commands = follow_path(path, SPEED, ACCELERATION, INTERVAL)
    assert distance_to_capsules(commands, path[:-1], path[1:], np.zeros(corners)).min(1).max() < 1e-9
    np.testing.assert_allclose(commands[-1], path[-1], atol=1e-12)
    steps = np.diff(commands, axis=0, prepend=path[:1])
    assert (np.abs(steps) <= SPEED * INTERVAL + 1e-9).all()
    if corners == 1:  # a corner's jump is bounded by the tolerance instead
        change = np.abs(np.diff(steps, axis=0, prepend=0 * steps[:1], append=0 * steps[:1]))
        assert (change <= ACCELERATION * INTERVAL**2 + 1e-9).all()


def test_a_long_line_takes_the_least_time() -> None:
    # 1.6 rad at 1.6 rad/s, and half the speed's ramp time at each end
    commands = follow_path([[0, 0, 0], [1.6, 0, 0]], SPEED, ACCELERATION, INTERVAL)
    assert len(commands) == np.ceil((1.0 + 1.6 / 14) / INTERVAL)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_a_lagging_arm_stays_near_the_path(seed: int) -> None:
    """A first-order servo with the documented lag, driven by ramps between the commands."""
    rng, lag, tolerance = np.random.default_rng(seed), 0.06, 0.004
    path = np.cumsum(rng.normal(size=(6, 3)), axis=0)
    commands = np.concatenate([path[:1], follow_path(path, SPEED, ACCELERATION, INTERVAL, tolerance, lag)])
    fine = 50
    state, trace = path[0].copy(), []
    for a, b in pairwise(commands):
        for k in range(1, fine + 1):
            state += (a + k / fine * (b - a) - state) * (1 - np.exp(-INTERVAL / fine / lag))
            trace.append(state.copy())
    away = distance_to_capsules(trace, path[:-1], path[1:], np.zeros(5)).min(1).max()
    assert away < 12 * tolerance


def test_a_straight_waypoint_is_passed_at_full_speed() -> None:
    whole = follow_path([[0, 0, 0], [2, 0, 0]], SPEED, ACCELERATION, INTERVAL)
    split = follow_path([[0, 0, 0], [1, 0, 0], [1, 0, 0], [2, 0, 0]], SPEED, ACCELERATION, INTERVAL)
    np.testing.assert_allclose(whole, split, atol=1e-9)


def test_no_way_no_commands() -> None:
    assert follow_path([[1, 2, 3]], SPEED, ACCELERATION, INTERVAL).shape == (0, 3)
    assert follow_path([[1, 2, 3], [1, 2, 3]], SPEED, ACCELERATION, INTERVAL).shape == (0, 3)


@pytest.mark.parametrize("interval", [0.0, -1.0, np.nan])
def test_bad_intervals(interval: float) -> None:
    with pytest.raises(InvalidValueError, match="positive"):
        follow_path([[0, 0, 0], [1, 1, 1]], SPEED, ACCELERATION, interval)


def test_commands_are_free_between_themselves(scene: Scene) -> None:
    arm = get_robot("ur5e")
    limits = (np.full(6, 1.6), arm.acceleration_limits, 0.05)
    compiled = compile_scene(scene, arm)
    for target in range(4):
        path = plan(scene, target).path
        assert path is not None
        commands = free_commands(compiled, target, path, *limits)
        checker = CollisionChecker(planning_model(compiled, target, margin=0.0))
        assert np.allclose(commands[-1], path[-1], atol=1e-12)
        assert checker.path_is_free(np.concatenate([path[:1], commands]), 0.002)


def test_corners_are_taken_slowly_where_cutting_them_would_touch(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    arm = get_robot("ur5e")
    limits = (np.full(6, 1.6), arm.acceleration_limits, 0.05)
    path = arm.start + np.array([np.zeros(6), [0.3, 0, 0, 0, 0, 0], [0.3, 0.3, 0, 0, 0, 0]])
    usual = free_commands(compile_scene(scene, arm), 0, path, *limits)
    assert np.array_equal(usual, follow_path(path, *limits))
    verdicts = iter([False, False, True])
    monkeypatch.setattr(CollisionChecker, "path_is_free", lambda *_: next(verdicts))
    careful = free_commands(compile_scene(scene, arm), 0, path, *limits)
    assert np.array_equal(careful, follow_path(path, *limits, corner_tolerance=CORNER_TOLERANCE / 4))
    assert len(careful) > len(usual)
