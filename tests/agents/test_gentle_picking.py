"""Gentle motions of a pick, and the surface that a camera sees as plants move."""

from types import SimpleNamespace

import numpy as np
import pytest

from greenhouse_gym.agents.picking import gently
from greenhouse_gym.agents.seen_surface import SeenSurface
from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.robots import get_robot

FORWARD = (np.array([0.1, 0.0, 0.0]), np.zeros(3))


def twists(force, hanging, count=10):
    hand = SimpleNamespace(force=np.array(force), held=3, hanging=lambda: [3] if hanging else [])
    return [velocity for velocity, _ in gently(hand, [FORWARD] * count)]


def test_motions_begin_slowly_and_reach_their_pace():
    speeds = [velocity[0] for velocity in twists([0.0, 0.0, 0.0], hanging=True)]
    assert speeds[0] < 0.03
    assert np.all(np.diff(speeds) >= 0)
    assert speeds[-1] == pytest.approx(0.1)


def test_a_fruit_that_is_off_yields_to_what_a_pedicel_may_pull_with():
    sideways = [0.0, 2.0, 0.0]
    hanging, off = twists(sideways, hanging=True)[-1], twists(sideways, hanging=False)[-1]
    np.testing.assert_allclose(hanging, FORWARD[0])
    assert off[0] < 0.06
    assert off[1] > 0.05, "it gives way"


def test_motions_yield_to_more_than_a_pedicel_bears():
    velocity = twists([-15.0, 0.0, 0.0], hanging=True)[-1]
    assert velocity[0] < 0


def test_points_are_given_up_that_the_camera_looks_through():
    camera, robot = DepthCamera("wrist", 16, 12), get_robot("ur5e")
    surface = SeenSurface(arm_spheres(robot), camera)
    view = np.eye(3), np.array([0.0, 0.0, 3.0])  # far above the arm

    def see(depth):
        depth = np.asarray(depth, dtype=np.float64)
        surface.see(depth, view[1] + depth[:, None] * camera.rays, view, robot.start)

    see(np.full(16 * 12, 0.5))
    near = len(surface.points)
    assert near > 100
    half = np.full((12, 16), 0.5)
    half[:, 8:] = 0.8
    see(half.ravel())
    heights = surface.points[:, 2] - 3.0
    assert (np.isclose(heights, 0.5)).sum() == pytest.approx(near / 2, abs=12)
    assert (surface.points[np.isclose(heights, 0.5), 0] <= 0).all()
    see(np.zeros(16 * 12))
    assert len(surface.points) == 0, "nothing within the camera's range"
