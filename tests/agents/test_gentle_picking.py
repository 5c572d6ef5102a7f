"""Gentle motions of a pick, and the surface that a camera sees as plants move."""

from types import SimpleNamespace

import numpy as np
import pytest

from greenhouse_gym.agents.harvest.picking import back_off, bring, feel, gently, lift
from greenhouse_gym.agents.harvest.seen_surface import SeenSurface
from greenhouse_gym.agents.harvest.sensed_hand import SensedHand
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
    surface = SeenSurface(arm_spheres(robot), camera, lambda points: np.zeros(len(points), dtype=bool))
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


def test_leaves_are_broad_and_stems_are_thin():
    camera, robot = DepthCamera("wrist", 64, 48), get_robot("ur5e")
    surface = SeenSurface(arm_spheres(robot), camera, lambda points: np.zeros(len(points), dtype=bool))
    origin = np.array([0.0, 0.0, 3.0])  # far above the arm
    column = np.arange(64) * np.ones((48, 1))
    depth = np.where(column < 30, 0.4, np.where((column >= 40) & (column < 42), 0.3, 0.0)).ravel()
    surface.see(depth, origin + depth[:, None] * camera.rays, (np.eye(3), origin), robot.start)
    near, far = (np.isclose(surface.points[:, 2] - 3.0, at) for at in (0.3, 0.4))
    assert near.any()
    assert not surface.broad[near].any(), "a stem of 13 mm"
    assert surface.broad[far].mean() > 0.9, "a leaf"


@pytest.mark.parametrize(("motion", "sign"), [(feel, 1), (back_off, -1)])
def test_the_cup_moves_along_its_axis(motion, sign):
    axis = np.array([0.0, 0.6, 0.8])
    hand = SimpleNamespace(tip=(np.zeros(3), axis), held=-1, interval=0.05)
    steps = [velocity * hand.interval for velocity, _ in motion(hand, 0.02, 0.05)]
    np.testing.assert_allclose(sum(steps), sign * 0.02 * axis)
    hand.held = 0
    assert len(list(feel(hand, 0.02, 0.05))) == 0


def test_a_held_fruit_is_lifted_straight_up():
    hand = SimpleNamespace(held=1, interval=0.05)
    np.testing.assert_allclose(sum(velocity * 0.05 for velocity, _ in lift(hand, 0.03)), [0.0, 0.0, 0.03])
    hand.held = -1
    assert not list(lift(hand, 0.03))


def test_a_held_fruit_is_brought_back_to_a_point():
    hand = SimpleNamespace(tip=(np.array([0.1, -0.05, 0.0]), np.eye(3)[2]), held=1, interval=0.05)
    speeds = []
    for velocity, spin in bring(hand, np.array([0.0, 0.0, 0.02])):
        assert not spin.any()
        speeds.append(np.linalg.norm(velocity))
        hand.tip = (hand.tip[0] + hand.interval * velocity, hand.tip[1])
    np.testing.assert_allclose(hand.tip[0], [0.0, 0.0, 0.02], atol=1e-3)
    assert max(speeds) <= 0.25 + 1e-9
    hand.held = -1
    assert not list(bring(hand, np.ones(3)))


@pytest.mark.parametrize(
    ("force", "pulls"),
    [([0, 0, -1.0], False), ([0.5, -0.5, -1.9], False), ([2.5, 1.7, -0.6], True), ([-0.5, 4, 3], True)],
)
def test_a_fruit_that_hangs_pulls_sideways_and_one_that_is_heavier_than_it_looks_does_not(force, pulls):
    hand = SimpleNamespace(force=np.array(force, dtype=float), _weight=1.6)
    assert SensedHand.pulls.fget(hand) == pulls
