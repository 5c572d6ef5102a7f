from __future__ import annotations

import numpy as np
import pytest
from reach_helpers import REACH, scene_of, tool_at

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.envs import DepthCamera, DepthObservation, GreenhouseEnv, PointsObservation, Randomization
from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.geometry import Sphere, distance_to_shapes
from greenhouse_gym.rendering.cameras import MAX_RANGE
from greenhouse_gym.scene import Scene, SceneBank


def looking_at_a_tomato() -> tuple[Scene, np.ndarray]:
    tip, frame = tool_at(REACH)
    tomato = Tomato(Sphere(tip + 0.25 * frame[:, 2], 0.05), truss=0)
    return scene_of([tomato], [Stem([0.75, 0.0, 0.3], [0.75, 0.0, 2.0], 0.01, kind="main")]), REACH


def observe(bank: SceneBank, placed: Scene, start: np.ndarray, **keywords: object) -> dict[str, np.ndarray]:
    env = GreenhouseEnv(bank=bank, **keywords)
    observation, _ = env.reset(seed=0, options={"scene": placed, "target": 0, "start": start})
    assert env.observation_space.contains(observation)
    return observation


def test_the_wrist_sees_the_tomato_ahead_at_its_distance(bank: SceneBank) -> None:
    placed, start = looking_at_a_tomato()
    camera = DepthCamera("wrist", 161, 121)
    image = observe(bank, placed, start, observation=DepthObservation(camera))["depth"][0] * MAX_RANGE
    # The camera stands 0.13 m behind the tip and 0.07 m off the tool, the tomato's center 0.25 m ahead of the tip.
    column = round(camera.width / 2 - camera.focal * 0.07 / 0.38 - 0.5)
    row = camera.height // 2
    assert 0.33 <= image[row, column] <= 0.335  # nearest point of a ball of 0.05 m, seen slightly from the side
    assert (image[:, :5] != image[row, column]).all()


def test_cameras_agree_with_the_shapes(bank: SceneBank) -> None:
    """Every point of the cloud lies on a surface that is there, and the plants are among them."""
    placed, start = looking_at_a_tomato()
    cloud = observe(bank, placed, start, observation=PointsObservation(DepthCamera("mast", 96, 72)))["points"]
    points = cloud[np.any(cloud != 0, axis=1)].astype(np.float64) + [0, 0, 1.1 - 0.1625]
    gaps = np.abs(distance_to_shapes(points, placed.obstacles)).min(axis=1)
    on_floor = np.abs(points[:, 2]) < 1e-3
    at_cart = (np.abs(points[:, :2]) < 0.121).all(axis=1)  # the cart
    assert (gaps[~on_floor & ~at_cart] < 1e-3).all()
    assert (gaps < 1e-3).sum() > 20


def test_the_cloud_leaves_the_arm_out(bank: SceneBank) -> None:
    placed, start = looking_at_a_tomato()
    camera = DepthCamera("mast", 64, 48)
    image = observe(bank, placed, start, observation=DepthObservation(camera))["depth"].reshape(-1)
    cloud = observe(bank, placed, start, observation=PointsObservation(camera))["points"]
    seen = np.any(cloud != 0, axis=1)
    assert (image > 0).sum() > seen.sum() > 0
    assert not (seen & (image == 0)).any()


def test_noise_is_drawn_from_the_episodes_seed(bank: SceneBank) -> None:
    placed, start = looking_at_a_tomato()
    keywords = {"observation": DepthObservation(DepthCamera("wrist", 160, 120))}
    clean = observe(bank, placed, start, **keywords)["depth"] * MAX_RANGE
    noisy, again = (
        observe(bank, placed, start, **keywords, randomization=Randomization(depth_noise=True))["depth"] * MAX_RANGE
        for _ in range(2)
    )
    np.testing.assert_array_equal(noisy, again)
    both = (clean > 0) & (noisy > 0)
    assert 0.5 < both.sum() / (clean > 0).sum() < 1
    error = np.abs(noisy - clean)[both]
    assert 1e-4 < np.median(error) < 0.02


@pytest.mark.parametrize("settings", [{"mount": "nose"}, {"width": 0}, {"field_of_view": 180.0}])
def test_bad_cameras_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(GreenhouseError):
        DepthCamera(**settings)
