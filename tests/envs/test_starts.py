from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import SceneBank, compile_scene
from greenhouse_gym.scene.truth import is_in_plants, own_start, start_is_collision_free, true_scene

TOUCHED = "helios-beefsteak-2009-w09-03"
"""The shipped scene whose true leaves, cut into boxes again after it was built, reach to the arm's own start."""


def begun(start: str | None = None, options: dict[str, Any] | None = None, **settings: Any) -> tuple[Any, Any]:
    """Return an environment's arm at the beginning of an episode in that scene, and the info after a step."""
    env = gymnasium.make("TomatoReach-v0", split="test", start=start, scene=TOUCHED, **settings)
    env.reset(seed=0, options=options)
    base: Any = env.unwrapped
    info = env.step(np.zeros(env.action_space.shape, np.float32))[-1]
    return base.simulation.episode(0).start, info


@pytest.mark.parametrize(
    ("settings", "touches"),
    [({"physics": "truth"}, True), ({"physics": "truth", "plants": "brush"}, False), ({}, False)],
    ids=["truth", "leaves-give-way", "scan"],
)
def test_an_arm_that_would_begin_in_true_plants_begins_upright(settings: dict[str, Any], touches: bool) -> None:
    robot = get_robot("ur5e")
    for named in (None, "ready"):
        start, info = begun(named, **settings)
        np.testing.assert_array_equal(start, robot.rating_start if touches else robot.start)
        assert not info["collision"]


def test_a_start_that_is_asked_for_stays() -> None:
    start, info = begun(options={"start": "ready"}, physics="truth")
    np.testing.assert_array_equal(start, get_robot("ur5e").start)
    assert info["collision"]
    bent = get_robot("ur5e").rating_start + 0.1
    np.testing.assert_array_equal(begun(options={"start": bent}, physics="truth")[0], bent)


@pytest.mark.parametrize("start", [None, "ready", "upright"])
def test_arms_begin_alike_on_warp(start: str | None) -> None:
    robot = get_robot("ur5e")
    names = [name for name in SceneBank.open("default").names("test") if name.startswith("helios-beefsteak")]
    settings: dict[str, Any] = {"split": "test", "physics": "truth", "start": start, "observation": "state"}
    envs = gymnasium.make_vec("TomatoReach-v0", num_envs=len(names), backend="warp", **settings)
    envs.reset(seed=0, options=[{"scene": name} for name in names])
    base: Any = envs.unwrapped
    joints = base.simulation.state.joints.numpy()
    for name, found in zip(names, joints, strict=True):
        upright = start == "upright" or name == TOUCHED
        np.testing.assert_allclose(found, robot.rating_start if upright else robot.start, atol=1e-6, err_msg=name)


def test_a_start_that_is_asked_for_stays_on_warp_and_for_one_episode() -> None:
    robot = get_robot("ur5e")
    settings: dict[str, Any] = {"split": "test", "physics": "truth", "scene": TOUCHED}
    envs = gymnasium.make_vec("TomatoReach-v0", num_envs=2, backend="warp", **settings)
    joints = envs.unwrapped.simulation.state.joints  # type: ignore[attr-defined]
    envs.reset(seed=0, options=[{"start": "ready"}, {"start": robot.rating_start + 0.1}])
    np.testing.assert_allclose(joints.numpy(), [robot.start, robot.rating_start + 0.1], atol=1e-6)
    envs.reset(seed=0)
    np.testing.assert_allclose(joints.numpy(), [robot.rating_start] * 2, atol=1e-6)


def test_only_one_shipped_scene_touches_the_arm() -> None:
    bank = SceneBank.open("default")
    near = [name for name in bank.names("test") if name.startswith(TOUCHED[:-3])]
    assert [name for name in near if not start_is_collision_free(bank.scene(name), "ur5e")] == [TOUCHED]
    compiled = compile_scene(true_scene(bank.scene(TOUCHED)), "ur5e")
    assert is_in_plants(compiled, compiled.robot.start)
    assert not is_in_plants(compiled, own_start(compiled))
