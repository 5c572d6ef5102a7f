"""The kernels against MuJoCo: distances of pairs of geoms, and verdicts on whole scenes."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from conftest import with_ellipsoids

from greenhouse_gym.motion.collision import PROOF, CollisionChecker, planning_model
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.motion.kernel_checker import KernelChecker, kernel_world, search_checker
from greenhouse_gym.motion.proof import ProvingChecker, checker_of
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.mjcf import compile_scene

KINDS = ("sphere", "capsule", "ellipsoid", "box", "plane")


def pair(rng: np.random.Generator, kind: str, arm: str, margin: float = 0.0) -> str:
    """A sliding geom and a fixed one as MJCF; thin and flat shapes and parallel axes are common."""

    def numbers(values: np.ndarray) -> str:
        return " ".join(f"{value:.9g}" for value in values)

    def quat() -> str:
        return numbers(rng.normal(size=4)) if rng.random() < 0.7 else "1 0 0 0"

    size = 10.0 ** rng.uniform(-3, -0.5, 3)
    geom = f"type='{kind}' size='{numbers(size)}' pos='{numbers(rng.uniform(-0.4, 0.4, 3))}' quat='{quat()}'"
    moving = f"type='{arm}' size='{numbers(10.0 ** rng.uniform(-2.5, -0.5, 2))}' quat='{quat()}'"
    axis = numbers(rng.normal(size=3))
    return (
        f"<mujoco><worldbody><geom name='fixed' {geom} margin='{margin!r}'/>"
        f"<body pos='{numbers(rng.uniform(-0.4, 0.4, 3))}' quat='{quat()}'><joint type='slide' axis='{axis}'/>"
        f"<geom name='moving' {moving}/><site name='tip'/></body></worldbody></mujoco>"
    )


@pytest.mark.parametrize("arm", ["capsule", "sphere"])
@pytest.mark.parametrize("kind", KINDS)
def test_distances_are_mujocos(kind: str, arm: str) -> None:
    """A pair is in contact if its margin is a little larger than the distance, and not if it is a little smaller."""
    compared = 0
    for seed in range(60):
        model = mujoco.MjModel.from_xml_string(pair(np.random.default_rng(seed), kind, arm))
        data, q = mujoco.MjData(model), np.random.default_rng(seed).uniform(-0.3, 0.3, (1, 1))
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        distance = mujoco.mj_geomDistance(model, data, 0, 1, 5.0, None)
        if distance < 1e-4:
            if distance < -1e-3:  # deep inside
                assert not search_checker(model).are_free(q)[0]
            continue
        compared += 1
        for margin, free in ((distance - 2e-5, True), (distance + 2e-5, False)):
            checked = mujoco.MjModel.from_xml_string(pair(np.random.default_rng(seed), kind, arm, margin))
            checker = search_checker(checked)
            assert isinstance(checker, KernelChecker)
            assert checker.are_free(q)[0] == free, (seed, distance)
    assert compared > 12


@pytest.mark.parametrize("robot", ["ur5e", "iiwa14"])
def test_verdicts_are_mujocos(scene: Scene, robot: str) -> None:
    arm = get_robot(robot)
    rng = np.random.default_rng(0)
    for each in (scene, with_ellipsoids(scene, 0), SceneBank.open("mini")[0]):
        model = planning_model(compile_scene(each, arm), 0)
        exact, checker = CollisionChecker(model), search_checker(model)
        assert isinstance(checker, KernelChecker)
        near = np.clip(arm.start + rng.normal(0, 0.6, (500, len(arm.joints))), arm.lower, arm.upper)
        configurations = np.concatenate([rng.uniform(arm.lower, arm.upper, near.shape), near])
        expected = np.array([exact.is_free(q) for q in configurations])
        assert 0.1 < expected.mean() < 0.95
        np.testing.assert_array_equal(checker.are_free(configurations), expected)
        assert checker.checks == exact.checks
        np.testing.assert_array_equal([checker.is_free(q) for q in configurations[::7]], expected[::7])


def test_motions_are_checked_alike_and_counted_alike(scene: Scene) -> None:
    arm = get_robot("ur5e")
    model = checker_of(compile_scene(scene, arm), 4).model
    exact = CollisionChecker(model, arm_reaches(arm))
    checker, back = (search_checker(exact.model, exact.reaches) for _ in range(2))
    rng, verdicts = np.random.default_rng(3), []
    for _ in range(60):
        end = np.clip(arm.start + rng.uniform(-1.5, 1.5, 6), arm.lower, arm.upper)
        for resolution in (PROOF, 6 * PROOF, 100.0):
            free = exact.motion_is_free(arm.start, end, resolution)
            assert checker.motion_is_free(arm.start, end, resolution) == free
            assert back.motion_is_free(end, arm.start, resolution) == free
            verdicts.append(free)
    assert checker.checks == exact.checks
    assert 30 < sum(verdicts) < 170
    assert checker.clearance(arm.start) == exact.clearance(arm.start)
    assert checker.are_free(np.empty((0, 6))).tolist() == []


def test_what_no_kernel_computes_is_left_to_mujoco() -> None:
    source = pair(np.random.default_rng(0), "sphere", "capsule")
    for old, new in (("type='capsule'", "type='cylinder'"), ("type='sphere'", "type='cylinder'"), ("'tip'", "'top'")):
        model = mujoco.MjModel.from_xml_string(source.replace(old, new))
        assert kernel_world(model) is None
        assert isinstance(search_checker(model), ProvingChecker)
