"""Rehearsals: what an agent would do in a known scene, found out before the arm moves.

The arm is simulated as the environment simulates it, but alone. As long as it touches nothing, the environment's arm
would move in the same way; so its motion is checked for collisions afterwards.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import mujoco
import numpy as np

from greenhouse_gym.agents.agent import Agent, Problem
from greenhouse_gym.envs.actions import CommandLimits, ToolMotion
from greenhouse_gym.envs.choices import make_observation
from greenhouse_gym.envs.state import State, control_timing
from greenhouse_gym.envs.stepping import drive_and_record
from greenhouse_gym.envs.tasks import TomatoReach
from greenhouse_gym.geometry import Array, invert, transform
from greenhouse_gym.motion.collision import PROOF, planning_model
from greenhouse_gym.motion.distance_field import FieldsOfSimulations, FieldStore
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.motion.kernel_checker import search_checker
from greenhouse_gym.motion.success import is_reached
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import compile_scene
from greenhouse_gym.scene.mjcf import CompiledScene, arm_pose
from greenhouse_gym.scene.obstacles import Surroundings

MARGIN = 0.001
"""Distance from obstacles that a rehearsed motion must keep, metres."""


def rehearse(agent: Agent, problem: Problem) -> Array | None:
    """Return the commands of an agent that reaches the target in the known scene and touches nothing.

    Args:
        agent: An agent with joint actions on the observation "state".
        problem: The episode: a known scene and the configuration in which the arm rests at first.

    Returns:
        (t, j) commanded joint positions after each action, radians; None if the target is not reached in fewer
        actions than the episode allows, or something is touched.
    """
    arm, world = _Arm(problem), _world(problem)
    observe: Callable[[State], Any] = make_observation("state", problem.robot, TomatoReach())
    agent.reset(problem)
    joints, commands = [problem.start], [problem.start]
    for _ in range(problem.step_limit):
        state = arm.state(world)
        if is_reached(float(np.linalg.norm(state.grasp - state.target))):
            break
        action = np.clip(np.asarray(agent.act(observe(state)[0]), dtype=np.float64), -1.0, 1.0)
        commands.append(arm.act(action, commands[-1]))
        joints.append(arm.data.qpos.copy())
    else:
        return None
    checker = search_checker(planning_model(problem.compiled, problem.target, MARGIN), arm_reaches(problem.robot))
    return np.array(commands[1:]) if checker.path_is_free(joints, PROOF) else None


class _World(NamedTuple):
    """Obstacles and target as an agent observes them.

    Attributes:
        fields: Distance field of the scene.
        target: (1, 3) center of the target in the base frame, metres.
        radius: Its radius, metres.
    """

    fields: FieldsOfSimulations
    target: Array
    radius: float


def _world(problem: Problem) -> _World:
    scene, target, store = problem.scene, problem.target, FieldStore()
    base = arm_pose(scene, problem.robot)
    slot, tomato = store.add(scene.arrays, len(scene.tomatoes), base), scene.tomatoes[target]
    fields = FieldsOfSimulations(store, np.array([slot]), np.array([target]), np.zeros((1, 1, 3)))
    return _World(fields, transform(invert(base), tomato.center[None]), tomato.radius)


class _Arm:
    """An arm at rest at the start of a problem, simulated without obstacles."""

    def __init__(self, problem: Problem):
        self._robot, self._rule, self._timing = problem.robot, problem.rule, control_timing(1 / problem.interval)
        self._limits = CommandLimits(problem.robot, problem.rule, self._timing)
        compiled = _alone(problem.robot, self._timing.substeps)
        self._model, self._points = compiled.model, np.array([compiled.tip_site, *compiled.probe_sites])
        self._base_from_scene = invert(arm_pose(compiled.scene, problem.robot))
        self.data = mujoco.MjData(self._model)
        self.data.qpos[:] = self.data.act[:] = problem.start
        mujoco.mj_kinematics(self._model, self.data)

    def act(self, action: Array, command: Array) -> Array:
        """Run an action (j,) after a command (j,); return the new command, radians."""
        model, data, joints = self._model, self.data, self.data.qpos
        change = self._rule(action[None], _UNKNOWN, _NO_MOTION)
        end: Array = self._limits(command[None], change, joints[None]).position[0]
        data.ctrl[:] = (end - data.act) / self._timing.interval
        mujoco.mj_step(model, data, self._timing.substeps)
        mujoco.mj_kinematics(model, data)
        return end

    def state(self, world: _World) -> State:
        """Return the state (1, ...) with what the observation "state" needs; the rest is None."""
        data, tip = self.data, int(self._points[0])
        turn = self._base_from_scene[:3, :3].T
        points = (data.site_xpos[self._points] @ turn + self._base_from_scene[:3, 3])[None]
        axis = (data.site_xmat[tip, 2::3] @ turn)[None]
        distance, direction = world.fields.lookup(points[:, 1:])
        return _UNKNOWN._replace(
            joints=data.qpos.copy()[None], velocities=data.qvel.copy()[None],
            command_error=(data.act - data.qpos)[None], tip=points[:, 0], axis=axis,
            grasp=points[:, 0] + world.radius * axis, target=world.target,
            clearance=distance - self._robot.probe_radii.astype(np.float32), obstacle=direction,
        )  # fmt: skip


_NOTHING: Any = None
_UNKNOWN = State(**dict.fromkeys(State._fields, _NOTHING))
_NO_MOTION = ToolMotion(*[_NOTHING] * len(ToolMotion._fields))


@lru_cache(maxsize=4)
def _alone(robot: Robot, substeps: int) -> CompiledScene:
    return compile_scene(Surroundings(name="alone"), robot, edit=partial(drive_and_record, substeps=substeps))
