"""The classical reactive controller: the tool is drawn to the target, the arm is pushed away from what is near."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.geometry import Array
from greenhouse_gym.scene import compile_scene

PULL = 0.02
"""Longest way that the grasp point is drawn in a step, metres."""

RANGE, PUSH = 0.05, 0.02
"""Clearance from which on a probe point of the arm is pushed away, and how far in a step on contact, metres."""

DAMPING = 0.05
"""Damping of the least squares, metres: near singular configurations the arm slows."""


class ResolvedRateAgent:
    """Resolved motion rate control (Whitney, 1969) with artificial repulsion (Khatib, 1986) at the arm's probe points.

    It reads offset, clearances and directions from the observation, and plans nothing: it stays where pull and push
    cancel. It needs an environment whose actions move the joints.
    """

    name = "resolved-rate"
    env_options: Mapping[str, Any] = MappingProxyType({"observation": "state"})

    def __init__(self) -> None:
        self._model: Any = None
        self._data: Any = None
        self._sites: tuple[int, ...] = ()
        self._steps = np.zeros(0)
        self._radius = 0.0
        self._scene_from_base = np.eye(3)

    def reset(self, problem: Problem) -> None:
        """Make the arm's kinematics ready."""
        compiled = compile_scene(problem.scene, problem.robot)
        self._model, self._data = compiled.model, mujoco.MjData(compiled.model)
        self._sites = (compiled.tip_site, *compiled.probe_sites)
        self._steps = problem.joint_steps
        self._radius = problem.scene.tomatoes[problem.target].radius
        cosine, sine = np.cos(problem.scene.placement.yaw), np.sin(problem.scene.placement.yaw)
        self._scene_from_base = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])

    def act(self, observation: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """The next action, (joints,) in [-1, 1]."""
        seen, n, k = np.asarray(observation, dtype=np.float64), len(self._steps), len(self._sites) - 1
        joints, rest = seen[:n], seen[3 * n :]
        offset = self._scene_from_base @ rest[:3]
        clearance = rest[6 : 6 + k]
        obstacles = rest[6 + k : 6 + 4 * k].reshape(k, 3) @ self._scene_from_base.T
        jacobians = self._jacobians(joints)
        pull = offset * min(1.0, PULL / max(float(np.linalg.norm(offset)), 1e-9))
        tool = jacobians[0]
        change = tool.T @ np.linalg.solve(tool @ tool.T + DAMPING**2 * np.eye(3), pull)
        for near, towards, jacobian in zip(clearance, obstacles, jacobians[1:], strict=True):
            push = PUSH * np.clip(1.0 - near / RANGE, 0.0, 1.0) * -towards
            change += jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + DAMPING**2 * np.eye(3), push)
        wish = change / self._steps
        return np.asarray(wish / max(1.0, float(np.abs(wish).max())), dtype=np.float32)

    def _jacobians(self, joints: Array) -> list[Array]:
        """(3, joints) of the grasp point and of the probe points, in the scene's frame."""
        model, data = self._model, self._data
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        result = []
        for k, site in enumerate(self._sites):
            ahead = self._radius * data.site_xmat[site].reshape(3, 3)[:, 2] if k == 0 else 0.0
            jacobian = np.empty((3, model.nv))
            mujoco.mj_jac(model, data, jacobian, None, data.site_xpos[site] + ahead, model.site_bodyid[site])
            result.append(jacobian)
        return result
