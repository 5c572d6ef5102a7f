"""Rehearsals: what a policy that moves to goal configurations would do in a known scene, before the arm moves.

The arm is simulated as the environment simulates it, alone. Where no obstacle is touched the environment's arm would
move in the same way, so the motion is checked for collisions afterwards.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.goal_inputs import goal_input
from greenhouse_gym.agents.policy import Float32, Policy
from greenhouse_gym.envs.actions import CommandLimits
from greenhouse_gym.envs.choices import make_observation
from greenhouse_gym.envs.features import feature_slices
from greenhouse_gym.envs.state import State, control_timing
from greenhouse_gym.envs.stepping import drive_and_record
from greenhouse_gym.envs.tasks import TomatoReach
from greenhouse_gym.geometry import Array, invert, transform
from greenhouse_gym.motion.collision import MARGIN, PROOF, planning_model
from greenhouse_gym.motion.distance_field import FieldsOfSimulations, FieldStore
from greenhouse_gym.motion.goal_options import MAX_OPTIONS, GoalOptions
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.motion.kernel_checker import search_checker
from greenhouse_gym.motion.success import SUCCESS_RADIUS
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene.mjcf import CompiledScene, arm_pose, compile_scene
from greenhouse_gym.scene.obstacles import Surroundings

MAX_STEPS = 120
"""Number of actions after which a rehearsal is given up."""

_AT_ONCE = 6  # goals, in the critic's order


class Rehearsed(NamedTuple):
    """A rehearsed motion that reaches the target and touches nothing.

    Attributes:
        goal: Index of its goal among the options.
        command: (t, j) commanded joint positions after each action, radians.
    """

    goal: int
    command: Array


class _World(NamedTuple):
    """Obstacles and target as the policy observes them.

    Attributes:
        fields: Distance field of the scene, for one simulation.
        target: (3,) center of the target in the base frame, metres.
        radius: Its radius, metres.
    """

    fields: FieldsOfSimulations
    target: Array
    radius: float


class _Rollouts(NamedTuple):
    """Rehearsed motions to k goals.

    Attributes:
        joints: (t + 1, k, j) joint positions before and after each action, radians.
        command: (t + 1, k, j) commanded joint positions, radians.
        length: (k,) number of actions until the target is reached; -1 where it is not.
    """

    joints: Array
    command: Array
    length: npt.NDArray[np.int64]


class Rehearsal:
    """Rehearses a policy for an arm.

    Args:
        policy: The policy, see `greenhouse_gym.agents.GoalChoosingAgent`.
        problem: An episode with the arm and the timing; its scene does not matter.
    """

    def __init__(self, policy: Policy, problem: Problem):
        self._policy, self._rule, robot = policy, problem.rule, problem.robot
        self._robot, self._timing = robot, control_timing(1 / problem.interval)
        self._limits = CommandLimits(robot, problem.rule, self._timing)
        self._observe = make_observation("state", robot, TomatoReach())
        self._at = feature_slices(self._observe.layout)
        alone = Surroundings(name="alone")
        compiled = compile_scene(alone, robot, edit=partial(drive_and_record, substeps=self._timing.substeps))
        self._model, self._points = compiled.model, np.array([compiled.tip_site, *compiled.probe_sites])
        self._base_from_scene = invert(arm_pose(alone, robot))
        self._arms = [mujoco.MjData(self._model) for _ in range(MAX_OPTIONS)]

    def first_free(
        self, known: CompiledScene, target: int, options: GoalOptions, joints: Array, command: Array
    ) -> Rehearsed | None:
        """Return the motion to the goal of the highest value among those that reach the target and touch nothing.

        Args:
            known: The scene as it is known.
            target: Index of the target tomato.
            options: Goals to choose from.
            joints: (j,) joint positions of the arm, which is at rest, radians.
            command: (j,) its commanded joint positions, radians.
        """
        world = _world(known, target)
        checker = search_checker(planning_model(known, target, margin=MARGIN / 2), arm_reaches(self._robot))
        for ids in self._best_first(world, options, joints, command):
            rollouts = self._roll(world, GoalOptions(*(part[ids] for part in options)), joints, command)
            for k, goal in enumerate(ids.tolist()):
                end = int(rollouts.length[k])
                if end > 0 and checker.path_is_free(rollouts.joints[: end + 1, k], PROOF):
                    return Rehearsed(goal, rollouts.command[1 : end + 1, k])
        return None

    def _best_first(
        self, world: _World, options: GoalOptions, joints: Array, command: Array
    ) -> list[npt.NDArray[np.int64]]:
        """Return the indices of the goals in groups, those of the highest value first."""
        if not len(options.configurations):
            return []
        state = self._place(self._arms[:1], world, joints, command)
        seen = np.repeat(self._observe(state), len(options.configurations), axis=0)
        order = (-self._policy.value(goal_input(seen, self._at, *options))).argsort(kind="stable")
        return np.split(order, range(_AT_ONCE, len(order), _AT_ONCE))

    def _roll(self, world: _World, options: GoalOptions, joints: Array, command: Array) -> _Rollouts:
        """Rehearse the motions to some goals until each has reached the target, or for `MAX_STEPS` actions."""
        arms = self._arms[: len(options.configurations)]
        state = self._place(arms, world, joints, command)
        length = np.full(len(arms), -1)
        positions, commands = [state.joints], [state.joints + state.command_error]
        for step in range(MAX_STEPS + 1):
            reached = np.linalg.norm(state.grasp - state.target, axis=1) < SUCCESS_RADIUS
            length[(length < 0) & reached] = step
            if (length >= 0).all() or step == MAX_STEPS:
                break
            action = np.clip(self._policy(goal_input(self._observe(state), self._at, *options)), -1.0, 1.0)
            change = self._rule(action.astype(np.float64), state, None)
            self._advance(arms, self._limits(commands[-1], change, state.joints).position)
            state = self._state(arms, world)
            positions.append(state.joints)
            commands.append(state.joints + state.command_error)
        return _Rollouts(np.array(positions), np.array(commands), length)

    def _place(self, arms: list[mujoco.MjData], world: _World, joints: Array, command: Array) -> State:
        """Place arms at rest; return their states."""
        for arm in arms:
            mujoco.mj_resetData(self._model, arm)
            arm.qpos[:], arm.act[:] = joints, command
            mujoco.mj_forward(self._model, arm)
        return self._state(arms, world)

    def _advance(self, arms: list[mujoco.MjData], command: Array) -> None:
        """Run one action, which ends with the commands (k, j)."""
        for arm, end in zip(arms, command, strict=True):
            arm.ctrl[:] = (end - arm.act) / self._timing.interval
            mujoco.mj_step(self._model, arm, self._timing.substeps)
            mujoco.mj_kinematics(self._model, arm)

    def _state(self, arms: list[mujoco.MjData], world: _World) -> State:
        """Return the states of arms, of which only what the observation "state" needs is known."""
        count, robot = len(arms), self._robot
        joints, velocities, command = (np.array([getattr(arm, name) for arm in arms]) for name in ("qpos", "qvel", "act"))
        turn = self._base_from_scene[:3, :3].T
        points = np.array([arm.site_xpos[self._points] for arm in arms]) @ turn + self._base_from_scene[:3, 3]
        axis = np.array([arm.site_xmat[self._points[0], 2::3] for arm in arms]) @ turn
        distance, direction = world.fields.select(np.zeros(count, dtype=np.int64)).lookup(points[:, 1:])
        known: dict[str, Any] = {
            "joints": joints, "velocities": velocities, "command_error": command - joints, "tip": points[:, 0],
            "axis": axis, "grasp": points[:, 0] + world.radius * axis,
            "target": np.broadcast_to(world.target, (count, 3)),
            "clearance": distance - robot.probe_radii.astype(np.float32), "obstacle": direction,
        }  # fmt: skip
        return State(**dict.fromkeys(State._fields) | known)


def _world(known: CompiledScene, target: int) -> _World:
    scene, base, store = known.scene, arm_pose(known.scene, known.robot), FieldStore()
    slot, tomato = store.add(scene.arrays, len(scene.tomatoes), base), scene.tomatoes[target]
    fields = FieldsOfSimulations(store, np.array([slot]), np.array([target]), np.zeros((1, 1, 3)))
    return _World(fields, transform(invert(base), tomato.center[None])[0], tomato.radius)
