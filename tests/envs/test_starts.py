from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from conftest import make_scene

from greenhouse_gym.geometry import Box
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank, Shapes, compile_scene
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.truth import is_in_plants, own_start, start_is_collision_free, true_scene

FREE, TOUCHED = "made-up-0", "made-up-1"


@pytest.fixture(scope="module")
def bank(tmp_path_factory: pytest.TempPathFactory) -> SceneBank:
    """A bank of two scenes; in the second, a true leaf that the scan does not show lies where the arm is ready."""
    scenes: list[tuple[Scene, str]] = []
    for k in range(2):
        scene = make_scene(k)
        leaves = tuple(scene.clutter) + (k == 1) * (Box(ready_tip(scene), [0.05, 0.05, 0.002], np.eye(3)),)
        truth = Shapes(tomatoes=scene.tomatoes, stems=scene.stems, clutter=leaves)
        scenes.append((scene.model_copy(update={"truth": truth}), "test"))
    return write_bank(tmp_path_factory.mktemp("starts") / "bank", scenes, "starts")


def ready_tip(scene: Scene) -> list[float]:
    compiled = compile_scene(scene, "ur5e")
    data = mujoco.MjData(compiled.model)
    data.qpos[:] = compiled.robot.starts["ready"]
    mujoco.mj_kinematics(compiled.model, data)
    return [float(value) for value in data.site("tip").xpos]


def begun(bank: SceneBank, start: str | None = None, options: dict[str, Any] | None = None, **settings: Any) -> Any:
    """Return an environment's arm at the beginning of an episode in that scene, and the info after a step."""
    env = gymnasium.make("TomatoReach-v0", bank=bank, split="test", start=start, scene=TOUCHED, **settings)
    env.reset(seed=0, options=options)
    base: Any = env.unwrapped
    info = env.step(np.zeros(env.action_space.shape or (), np.float32))[-1]
    return base.simulation.episode(0).start, info


@pytest.mark.parametrize(
    ("settings", "touches"),
    [({"physics": "truth"}, True), ({"physics": "truth", "plants": "brush"}, False), ({}, False)],
    ids=["truth", "leaves-give-way", "scan"],
)
def test_an_arm_that_would_begin_in_true_plants_begins_upright(
    bank: SceneBank, settings: dict[str, Any], touches: bool
) -> None:
    robot = get_robot("ur5e")
    for named in (None, "ready"):
        start, info = begun(bank, named, **settings)
        np.testing.assert_array_equal(start, robot.upright_start if touches else robot.start)
        assert not info["collision"]


def test_a_start_that_is_asked_for_stays(bank: SceneBank) -> None:
    start, info = begun(bank, options={"start": "ready"}, physics="truth")
    np.testing.assert_array_equal(start, get_robot("ur5e").start)
    assert info["collision"]
    bent = get_robot("ur5e").upright_start + 0.1
    np.testing.assert_array_equal(begun(bank, options={"start": bent}, physics="truth")[0], bent)


@pytest.mark.parametrize("start", [None, "ready", "upright"])
def test_arms_begin_alike_on_warp(bank: SceneBank, start: str | None) -> None:
    robot = get_robot("ur5e")
    settings: dict[str, Any] = {
        "bank": bank, "split": "test", "physics": "truth", "start": start, "observation": "state",
    }  # fmt: skip
    envs = gymnasium.make_vec("TomatoReach-v0", num_envs=2, backend="warp", **settings)
    envs.reset(seed=0, options=[{"scene": FREE}, {"scene": TOUCHED}])
    base: Any = envs.unwrapped
    free, touched = base.simulation.state.joints.numpy()
    np.testing.assert_allclose(free, robot.upright_start if start == "upright" else robot.start, atol=1e-6)
    np.testing.assert_allclose(touched, robot.upright_start, atol=1e-6)


def test_a_start_that_is_asked_for_stays_on_warp_and_for_one_episode(bank: SceneBank) -> None:
    robot = get_robot("ur5e")
    settings: dict[str, Any] = {"bank": bank, "split": "test", "physics": "truth", "scene": TOUCHED}
    envs = gymnasium.make_vec("TomatoReach-v0", num_envs=2, backend="warp", **settings)
    joints = envs.unwrapped.simulation.state.joints  # type: ignore[attr-defined]
    envs.reset(seed=0, options=[{"start": "ready"}, {"start": robot.upright_start + 0.1}])
    np.testing.assert_allclose(joints.numpy(), [robot.start, robot.upright_start + 0.1], atol=1e-6)
    envs.reset(seed=0)
    np.testing.assert_allclose(joints.numpy(), [robot.upright_start] * 2, atol=1e-6)


def test_the_scene_tells_whether_its_plants_are_in_the_way(bank: SceneBank) -> None:
    assert [name for name in bank.names() if not start_is_collision_free(bank.scene(name), "ur5e")] == [TOUCHED]
    compiled = compile_scene(true_scene(bank.scene(TOUCHED)), "ur5e")
    assert is_in_plants(compiled, compiled.robot.start)
    assert not is_in_plants(compiled, own_start(compiled))
