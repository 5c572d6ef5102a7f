"""Rehearsals: copies of a harvest in which an oracle tries its actions first."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import chain, repeat
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import JointAgent, Problem
from greenhouse_gym.agents.harvest.picking import Twist, joint_change
from greenhouse_gym.agents.planner_agent import safe_commands
from greenhouse_gym.envs.actions import CommandLimits
from greenhouse_gym.envs.state import control_timing
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.planning import plan
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import Chain, tool_chain
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.plants.live import LivePlants
from greenhouse_gym.scene.plants.live_scene import LiveScene, live_scene
from greenhouse_gym.scene.plants.states import HANGING, LOOSE

Action = npt.NDArray[np.float32]

_ONE = np.array([0])
_CHECKS = 60_000  # collision checks of a plan


class RehearsingAgent(JointAgent):
    """Base of oracles, which know the true plants and try their actions in copies of the simulation first.

    Args:
        planner: A name in `greenhouse_gym.planning.PLANNERS`.
        name: Name in tables.

    Attributes:
        status: Why there is nothing more to pick; empty meanwhile.
        needs: The task that it needs, in words of an error.
    """

    needs = 'task="harvest"'
    knows_truth = True
    env_options: Mapping[str, Any] = MappingProxyType(
        {**JointAgent.env_options, "plants": "compliant", "physics": "truth"}
    )

    def __init__(self, planner: str, name: str):
        self.planner, self.name, self.status = planner, name, ""
        self._script: Iterator[Action] | None = None

    def reset(self, problem: Problem) -> None:
        """Begin an episode.

        Raises:
            InvalidValueError: The environment has no compliant plants, or another task or tool.
        """
        if problem.rehearsal is None or not self._suits(Rehearsal(problem)):
            raise InvalidValueError(f'agent {self.name!r} needs {self.needs} with plants="compliant"')
        rest = np.append(np.zeros(len(problem.robot.joints)), -1.0).astype(np.float32)
        self.status, self._script = "", chain(self._actions(problem), repeat(rest))

    def act(self, observation: Any) -> Action:
        """Return the next action; at the end the arm rests with an open tool."""
        if self._script is None:
            raise RuntimeError("reset the agent before it acts")
        return next(self._script)

    def _suits(self, rehearsal: Rehearsal) -> bool:
        """Return whether the agent can work in an episode."""
        return True

    def _actions(self, problem: Problem) -> Iterator[Action]:
        """Yield the actions of an episode."""
        raise NotImplementedError


class Rehearsal:
    """Copy of a simulation in which actions are tried; the simulation itself repeats them bit for bit.

    Args:
        problem: The episode, of an agent with ``knows_truth``.

    Attributes:
        actions: Actions since the first copy was made.
        harm: Number of organs that they damaged and fruit that they knocked off.
        lost: Whether they dropped a fruit or ended the episode by a contact.
        failure: Why the last plan found no path.

    Raises:
        InvalidValueError: The environment has no compliant plants.
    """

    def __init__(self, problem: Problem):
        if problem.rehearsal is None:
            raise InvalidValueError('only agents that know the truth of plants="compliant" can rehearse')
        self._problem, self._physics = problem, problem.rehearsal()
        self._limit = CommandLimits(problem.robot, problem.rule, control_timing(1 / problem.interval))
        self.actions: list[Action] = []
        self.harm, self.lost, self.failure = 0, False, ""
        self._rehearsed = np.zeros((), dtype=np.int64)  # shared with twins
        self._felt = self._physics.felt(_ONE)

    def twin(self) -> Rehearsal:
        """Return an independent copy in the same state."""
        other = copy.copy(self)
        other._physics, other.actions = copy.deepcopy(self._physics), list(self.actions)
        return other

    @property
    def plants(self) -> LivePlants:
        """Plants of the copy."""
        return self._physics.simulation(0).plants

    @property
    def rehearsed(self) -> int:
        """Number of actions tried by this one and its twins."""
        return int(self._rehearsed)

    @property
    def held(self) -> int:
        """Fruit in the cup, or -1."""
        return self.plants.held

    def center(self, fruit: int) -> Array:
        """Return the middle (3,) of a fruit, metres."""
        return self.plants.center(fruit)

    def radius(self, fruit: int) -> float:
        """Return the radius of a fruit, metres."""
        return self.plants.radius(fruit)

    def joint(self, fruit: int) -> Array:
        """Return the start (3,) of the pedicel of a fruit, metres."""
        return self.plants.joint_of(fruit)

    def hanging(self) -> list[int]:
        """Return the fruit that hang."""
        hanging: list[int] = np.flatnonzero(self.plants.state == HANGING).tolist()
        return hanging

    @property
    def interval(self) -> float:
        """Seconds between two actions."""
        return self._problem.interval

    @property
    def chain(self) -> Chain:
        """Kinematic chain of the tool."""
        compiled = self._physics.simulation(0).world.compiled
        return tool_chain(compiled.model, compiled.tip_site)

    def scene(self, leaves: bool, around_crate: float = 0.0) -> LiveScene:
        """Return the true scene as it is now, see `greenhouse_gym.scene.plants.live_scene.live_scene`."""
        return live_scene(self.plants, self._physics.simulation(0).world.compiled, leaves, around_crate)

    @property
    def command(self) -> Array:
        """(joints,) commanded joint positions, radians."""
        return np.array(self._physics.command[0])

    @property
    def tip(self) -> tuple[Array, Array]:
        """Position (3,) and direction (3,) of the tool in the scene."""
        points, frames = self._physics.sites(_ONE)
        return points[0, 0], frames[0][:, 2]

    @property
    def shoulder(self) -> Array:
        """Position (3,) of the arm's shoulder in the scene, metres, where the cart stands."""
        base = self._physics.simulation(0).data.xpos[1]
        return np.asarray(base + [0.0, 0.0, self._problem.robot.shoulder_height])

    @property
    def frame(self) -> Array:
        """Axes (3, 3) of the tool in the scene, as columns."""
        return np.asarray(self._physics.sites(_ONE)[1][0])

    @property
    def force(self) -> Array:
        """Force (3,) of the held fruit on the cup beyond its weight in the last action, N, in the scene."""
        plants = self.plants
        return np.asarray(self._felt["force"][0]) - (plants.weight(plants.held) if plants.held >= 0 else 0.0)

    def step(self, change: Array, vacuum: bool) -> None:
        """Take the action that changes the commands by (joints,) as far as an action can."""
        steps = self._problem.joint_steps
        arm = np.clip(change / steps, -1, 1).astype(np.float32)
        action = np.append(arm, np.float32(1 if vacuum else -1))
        self.actions.append(action)
        command = self._limit(self._physics.command, steps * arm[None].astype(np.float64), self._physics.qpos)
        contacts = self._physics.advance(command.position, np.array([vacuum]))
        felt = self._felt = self._physics.felt(_ONE)
        self._rehearsed += 1
        self.harm += int(felt["damaged"][0] + felt["knocked"][0])
        self.lost |= bool(felt["dropped"][0]) or bool(contacts.collided[0])

    def move(self, twists: Iterable[Twist]) -> None:
        """Move the tip, one motion an action, with vacuum."""
        for twist in twists:
            data, joints = self._physics.simulation(0).data, len(self._problem.robot.joints)
            axes, anchors = data.xaxis[:joints], data.xanchor[:joints]
            sliding = self._problem.robot.sliding[:, None]
            linear = np.where(sliding, axes, np.cross(axes, self.tip[0] - anchors))
            jacobian = np.concatenate([linear, np.where(sliding, 0.0, axes)], axis=1).T
            jacobian[:, : int(self._problem.robot.on_rail)] = 0.0  # the cart stands
            self.step(joint_change(jacobian, twist, self.interval, self._problem.joint_steps), True)

    def follow(self, scene: Scene, target: int, planner: str, arm: Robot, goals: int | Array, seed: int = 0) -> str:
        """Plan and follow a path, without letting go; return the reason if none exists, else an empty text.

        Args:
            scene: Scene to plan in.
            target: Target in it, or any tomato that is far away if the goals are configurations.
            planner: Name of the planner.
            arm: The arm, with what it carries.
            goals: Number of configurations at the target, or (k, joints) goal configurations.
            seed: Number of the plan.
        """
        path = self.plan(scene, target, planner, arm, goals, seed)
        if path is None:
            return self.failure
        for command in safe_commands(scene, target, path, replace(self._problem, robot=arm)):
            self.step(command - self.command, self.plants.holding)
        return ""

    def plan(
        self, scene: Scene, target: int, planner: str, arm: Robot, goals: int | Array, seed: int = 0,
        start: Array | None = None, checks: int = _CHECKS,
    ) -> Array | None:  # fmt: skip
        """Return a path (k, joints); None without one.

        Args:
            scene: Scene to plan in.
            target: Target in it, see `follow`.
            planner: Name of the planner.
            arm: The arm, with what it carries.
            goals: Number of goal configurations, or these, see `follow`.
            seed: Number of the plan.
            start: (joints,) configuration to start in; None for the current commands.
            checks: Number of collision checks at most.
        """
        start = np.clip(self.command if start is None else start, arm.lower, arm.upper)
        if not isinstance(goals, int):  # a cart at the end of its rail is beyond it by rounding
            goals = np.clip(goals, arm.lower, arm.upper)
        result = plan(
            scene, target, arm, planner, time_limit=None, max_checks=checks, goals=goals,
            seed=self._problem.seed + seed, start=start,
        )  # fmt: skip
        self.failure = f"no plan: {result.status} {result.message}".strip()
        return result.path

    def wait(self, fruit: int, actions: int) -> None:
        """Hold still until a fruit has come to rest, for a number of actions at most."""
        for _ in range(actions):
            if self.plants.state[fruit] != LOOSE:
                return
            self.step(np.zeros(len(self._problem.robot.joints)), False)
