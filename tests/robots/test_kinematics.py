from __future__ import annotations

import mujoco
import numpy as np
import pytest

from greenhouse_gym.robots.kinematics import Chain, tool_chain, tool_state
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene

AHEAD = 0.03


@pytest.fixture(scope="module")
def compiled(scene: Scene) -> CompiledScene:
    turned = scene.model_copy(update={"placement": scene.placement.model_copy(update={"yaw": 0.4})})
    return compile_scene(turned)


@pytest.fixture(scope="module")
def chain(compiled: CompiledScene) -> Chain:
    return tool_chain(compiled.model, compiled.tip_site)


@pytest.fixture(scope="module")
def configurations(compiled: CompiledScene) -> np.ndarray:
    return np.random.default_rng(0).uniform(compiled.robot.lower, compiled.robot.upper, (200, 6))


def test_agrees_with_mujoco(compiled: CompiledScene, chain: Chain, configurations: np.ndarray) -> None:
    model, data = compiled.model, mujoco.MjData(compiled.model)
    state = tool_state(chain, configurations, AHEAD)
    jacobian = np.empty((3, model.nv))
    for i, q in enumerate(configurations):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        axis = data.site_xmat[compiled.tip_site].reshape(3, 3)[:, 2]
        point = data.site_xpos[compiled.tip_site] + AHEAD * axis
        mujoco.mj_jac(model, data, jacobian, None, point, model.site_bodyid[compiled.tip_site])
        np.testing.assert_allclose(state.axis[i], axis, atol=1e-9)
        np.testing.assert_allclose(state.point[i], point, atol=1e-9)
        np.testing.assert_allclose(state.jacobian[i], jacobian, atol=1e-9)


def test_jacobian_is_the_derivative(chain: Chain, configurations: np.ndarray) -> None:
    state, step = tool_state(chain, configurations, AHEAD), 1e-6
    for j in range(6):
        delta = step * np.eye(6)[j]
        difference = tool_state(chain, configurations + delta, AHEAD).point
        difference = (difference - tool_state(chain, configurations - delta, AHEAD).point) / (2 * step)
        np.testing.assert_allclose(state.jacobian[:, :, j], difference, atol=1e-8)


def test_a_joint_with_an_anchor_of_its_own() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body pos="0.1 0.2 0.3"><joint axis="0 1 0" pos="0.05 0 -0.1"/>
        <geom size="0.01"/><body pos="0 0 0.4" euler="10 20 30"><joint axis="1 0 0"/><joint axis="0 0 1" pos="0 0.1 0"/>
        <geom size="0.01"/><site name="tip" pos="0 0.1 0.2" euler="40 0 0"/></body></body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    data.qpos[:] = [0.3, -0.8, 1.1]
    mujoco.mj_kinematics(model, data)
    state = tool_state(tool_chain(model, 0), data.qpos[None])
    np.testing.assert_allclose(state.point[0], data.site_xpos[0], atol=1e-12)
    np.testing.assert_allclose(state.axis[0], data.site_xmat[0].reshape(3, 3)[:, 2], atol=1e-12)
