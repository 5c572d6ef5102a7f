"""Readings of depth images, perfect ones and ones with a stereo camera's noise, against the truth."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.agents import Problem
from greenhouse_gym.agents.local_map import LocalMap
from greenhouse_gym.agents.occupancy_map import OccupancyMap, wrist_camera, wrist_reading
from greenhouse_gym.agents.watchful import WatchfulAgent
from greenhouse_gym.capture import sense_depth
from greenhouse_gym.envs import GreenhouseEnv, Randomization
from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.rendering.cameras import MAX_RANGE, DepthCamera, stereo_noise
from greenhouse_gym.rendering.depth_reading import MAX_UNCERTAINTY, perfect_reading, stereo_reading
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene

CAMERA = DepthCamera(width=128, height=96)
STEP = 0.002  # added to the uncertainty of readings by the steps of disparities and depths, metres
ARM, TARGET = get_robot("ur5e"), 4


def leaves(seed: int) -> np.ndarray:
    """True depth (96, 128) of slanted leaves at 0.1 to 1.5 m, some before others, and nothing between them."""
    random = np.random.default_rng(seed)
    depth = np.full((96, 128), np.inf)
    down, right = np.mgrid[:96, :128]
    for _ in range(12):
        z, slant = random.uniform(0.1, 1.5), random.uniform(-0.4, 0.4, 2)
        row, column, high, wide = random.uniform((0, 0, 5, 5), (96, 128, 40, 40))
        inside = (np.abs(down - row) < high / 2) & (np.abs(right - column) < wide / 2)
        plane = z * (1 + (slant[0] * (down - row) + slant[1] * (right - column)) / CAMERA.focal)
        depth = np.where(inside & (plane > 0.05), np.minimum(depth, plane), depth)
    return np.where(depth <= MAX_RANGE, depth, 0.0)


def spoiled(true: np.ndarray, seed: int) -> np.ndarray:
    """The image that a D435 makes of it."""
    image = sense_depth(true, CAMERA.focal, np.random.default_rng(seed), stereo_noise(CAMERA))
    image[image > MAX_RANGE] = 0.0
    return image


def test_a_perfect_image_is_taken_at_its_word_and_a_single_hole_tells_nothing() -> None:
    image = np.full((9, 9), 0.5, dtype=np.float32)
    image[2, 2], image[5:, 5:] = 0.0, 0.0
    reading = perfect_reading(image)
    assert np.array_equal(reading.depth, image)
    assert not reading.uncertainty.any()
    assert [reading.free[k, k] for k in (0, 2, 8)] == [0.5, 0.0, MAX_RANGE]


@pytest.mark.parametrize("seed", range(6))
def test_readings_are_within_their_doubt_and_believed_only_where_that_is_small(seed: int) -> None:
    true = leaves(seed)
    reading = stereo_reading(spoiled(true, seed), CAMERA)
    read = reading.depth > 0
    off = np.abs(reading.depth - true)[read]
    assert read.sum() > 500
    assert (off <= reading.uncertainty[read] + STEP).mean() > 0.99
    assert reading.uncertainty[read].max() <= MAX_UNCERTAINTY + 1e-9


@pytest.mark.parametrize("seed", range(6))
def test_hardly_anything_hidden_counts_as_looked_through(seed: int) -> None:
    """Of a noisy image taken for a perfect one, much does: behind what is too near, and beside what is near."""
    true = leaves(seed)
    image = spoiled(true, seed)
    end = np.where(true > 0, true, np.inf)
    wrong = [
        (reading.free > end + reading.uncertainty + STEP).mean()
        for reading in (stereo_reading(image, CAMERA), perfect_reading(image))
    ]
    assert wrong[0] < 0.02
    assert wrong[1] > 3 * wrong[0]


def test_empty_space_beside_far_leaves_is_seen_but_not_beside_what_may_be_too_near() -> None:
    true = np.zeros((96, 128))
    true[30:60, 60:100] = 0.8
    seen = stereo_reading(spoiled(true, 0), CAMERA).free
    assert np.median(seen[:20, 40:]) > 0.9
    true[30:60, 60:80] = 0.2
    assert np.median(stereo_reading(spoiled(true, 0), CAMERA).free[:20, 40:]) == 0.0


def test_what_a_near_leaf_hides_from_the_right_imager_is_not_seen() -> None:
    true = np.zeros((96, 128))
    true[:, 90:120] = 0.4
    seen = stereo_reading(spoiled(true, 0), CAMERA).free[10:80]
    assert np.median(seen[:, 87]) < 0.7  # the leaf covers it, for the right imager
    assert np.median(seen[:, 60]) > 0.9


def test_an_image_without_any_reading_tells_nothing() -> None:
    image = np.zeros((96, 128), dtype=np.float32)
    reading = stereo_reading(image, CAMERA)
    assert not reading.depth.any()
    assert not reading.free.any()
    assert (perfect_reading(image).free == MAX_RANGE).all()


def test_nobody_looks_through_the_arm() -> None:
    """The cup is before the camera, nearer than its range: behind it is nothing that was seen."""
    arm = arm_spheres(ARM)
    joints = np.array([0.3, -1.2, 1.4, -0.6, -1.5, 0.0])
    far = np.zeros((96, 128), dtype=np.float32)
    far[:, ::2] = 1.0  # readings all over, so no part without one is large
    _, (eye,) = wrist_camera(arm.chain, joints[None])
    cup = arm.centers(joints[None])[0, -3:].mean(axis=0)  # three spheres cover it
    ahead = eye + (cup - eye) * np.linspace(1.5, 3.0, 4)[:, None]
    for noisy, seen in ((False, True), (True, False)):
        known = OccupancyMap(arm, CAMERA, np.array([0.0, 0.0, 2.0]), 0.03, noisy)
        known.add(far, joints)
        assert known.observed(ahead).any() == seen


def noisy_views(scene: Scene, agent: WatchfulAgent) -> tuple[GreenhouseEnv, dict[str, np.ndarray]]:
    env = GreenhouseEnv(
        bank="mini", start="upright", randomization=Randomization(depth_noise=True), **agent.env_options
    )
    observation, _ = env.reset(seed=3, options={"scene": scene, "target": TARGET})
    return env, observation


def test_noise_about_the_shapes_of_the_scan_is_no_obstacle(scene: Scene) -> None:
    agent = WatchfulAgent()
    env, observation = noisy_views(scene, agent)
    problem = Problem(scene, TARGET, ARM, env.start)
    agent.reset(problem)
    target = wrist_reading(observation, ARM).target
    wary, credulous = (LocalMap(problem, target, CAMERA, noisy=noisy) for noisy in (True, False))
    for _ in range(25):
        now = wrist_reading(observation, ARM)
        for known in (wary, credulous):
            known.add(now.depth, now.joints)
        observation, *_ = env.step(agent.act(observation))
    assert len(wary.points) < len(credulous.points) / 4


def test_with_noise_it_reaches(scene: Scene) -> None:
    agent = WatchfulAgent(noisy=True)
    env, observation = noisy_views(scene, agent)
    agent.reset(Problem(scene, TARGET, ARM, env.start))
    over = False
    while not over:
        observation, _, terminated, truncated, info = env.step(agent.act(observation))
        over = terminated or truncated
    assert info["is_success"]
