"""An agent that harvests with the scan and the color camera at its wrist alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import NamedAgent, Problem
from greenhouse_gym.agents.fruit_map import FruitMap
from greenhouse_gym.agents.occupancy_map import wrist_camera
from greenhouse_gym.agents.picking import (
    Twist,
    close_gap,
    joint_change,
    part,
    pointing_down,
    retreats,
    spot,
    turns,
    with_fruit,
    withdraw,
)
from greenhouse_gym.agents.planner_agent import safe_commands
from greenhouse_gym.envs.features import feature_slices
from greenhouse_gym.envs.image_observations import RgbObservation
from greenhouse_gym.envs.tasks.harvest import TomatoHarvest
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, Box, pose, rotation_about
from greenhouse_gym.motion.unknown_space import guarded
from greenhouse_gym.planning import plan
from greenhouse_gym.plants.mechanics import GRAVITY, PlantMechanics
from greenhouse_gym.rendering.cameras import MAX_RANGE, DepthCamera
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import tool_chain, tool_state
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import base_position

Action = npt.NDArray[np.float32]

IMAGE = (64, 48)
"""Width and height of the camera's images, pixels."""

_CHECKS, _GOALS = 40_000, 30  # collision checks of a plan, and configurations at a fruit
_SCENES = (("rigid", 0.04), ("brush", 0.04), ("brush", 0.0))  # how leaves are planned with, and metres around the crate
_TRIES = 3  # picks of a fruit before it is given up
_RETURN = 24  # actions by which the arm goes back the way it came after a pick that failed
_ATTEMPTS = 3  # withdrawals until there is a path to the crate
_DROPS = 3  # actions to let go
_ABOVE = 0.02  # metres above the rim of the crate
_EVERY = 2  # actions from one image to the next that is read
_FREE_FORCE, _TURNED = 1.0, 8  # N that a fruit pulls beyond its weight when it is off, and actions until this counts


class ScanHarvester(NamedAgent):
    """Pick the fruit that the scan shows one after the other, and follow them with the camera at the wrist.

    It plans in the scan to the nearest fruit, closes the gap by what the camera sees of it, turns it about the presumed
    joint of its pedicel until the force at the wrist says that it is off, withdraws, and plans to the crate. It never
    sees the true plants; which fruit are to be picked is a part of the problem.

    Args:
        name: Name in tables.
    """

    env_options: Mapping[str, Any] = MappingProxyType(
        {
            "task": "harvest", "plants": "compliant", "physics": "truth",
            "observation": RgbObservation(DepthCamera("wrist", *IMAGE), depth=True),
        }
    )  # fmt: skip

    def __init__(self, name: str = "harvest-scan"):
        self.name, self.status = name, ""
        self._hand: _SensedHand | None = None
        self._script: Iterator[Action] = iter(())

    def reset(self, problem: Problem) -> None:
        """Begin an episode.

        Raises:
            InvalidValueError: The environment has another task.
        """
        if problem.crate is None:
            raise InvalidValueError(f'agent {self.name!r} needs task="harvest"')
        self.status, self._hand = "", _SensedHand(problem)
        self._script = _Harvest(problem, self._hand).run()

    def act(self, observation: Any) -> Action:
        """Return the next action."""
        if self._hand is None:
            raise RuntimeError("reset the agent before it acts")
        self._hand.sense(observation)
        return next(self._script)


class _SensedHand:
    """Tool and fruit by the readings of the arm; stands in for `greenhouse_gym.agents.picking.Hand`.

    Args:
        problem: The episode.
    """

    def __init__(self, problem: Problem):
        self._problem, self.interval = problem, problem.interval
        compiled = guarded(problem.scene, problem.robot, problem.start, np.inf)
        self.chain = tool_chain(compiled.model, compiled.tip_site)
        self.fruit = FruitMap(problem.scene)
        self.working = -1
        self._camera = DepthCamera("wrist", *IMAGE)
        spec = RgbObservation(self._camera, depth=True)(problem.robot, TomatoHarvest())
        self._features = feature_slices(spec.layout)
        self._turn = rotation_about([0, 0, 1], problem.scene.placement.yaw)
        self._base = base_position(problem.scene, problem.robot)
        self._age, self._turned = 0, 0
        self.parting = False

    def sense(self, observation: Mapping[str, Any]) -> None:
        """Take over an observation."""
        state = observation["state"].astype(np.float64)

        def value(name: str) -> Array:
            return np.asarray(state[self._features[name]])

        robot = self._problem.robot
        self.joints = value("joint_position")
        self.command = np.clip(self.joints + value("command_error"), robot.lower, robot.upper)
        self._state = tool_state(self.chain, self.joints[None])
        self.holds = value("gripper")[0] > 0
        self._force = self._turn @ value("wrist_force")
        self.crate = self.tip[0] + self._turn @ value("crate_offset")
        self.left = int(round(value("fruit")[1]))
        if self._age % _EVERY == 0:
            turn, origin = (poses[0] for poses in wrist_camera(self.chain, self.joints[None]))
            depth = (observation["depth"][0] * MAX_RANGE).reshape(-1).astype(np.float64)
            points = origin + depth[:, None] * (self._camera.rays @ turn.T)
            self.fruit.see(points, observation["rgb"].reshape(3, -1).T, depth)
        self._age += 1
        if self.parting:
            self._turned += 1
            if self._turned > _TURNED and np.linalg.norm(self.force) < _FREE_FORCE:
                self.fruit.hanging[self.working] = False

    def begin(self, fruit: int) -> None:
        """Begin to turn a fruit off."""
        self.working, self.parting, self._turned = fruit, True, 0

    @property
    def held(self) -> int:
        """Fruit in the cup, or -1."""
        return self.working if self.holds else -1

    @property
    def tip(self) -> tuple[Array, Array]:
        """Position (3,) and direction (3,) of the tool in the scene."""
        return self._state.point[0], self._state.axis[0]

    @property
    def force(self) -> Array:
        """(3,) force of the held fruit on the cup beyond its weight, N, in the scene."""
        mass = PlantMechanics().density * 4 / 3 * np.pi * self.radius(self.working) ** 3 if self.holds else 0.0
        return np.asarray(self._force + [0.0, 0.0, GRAVITY * mass])

    def center(self, fruit: int) -> Array:
        """Return the middle (3,) of a fruit; a held one is at the cup."""
        if self.holds and fruit == self.working:
            tip, axis = self.tip
            return np.asarray(tip + self.radius(fruit) * axis)
        return np.asarray(self.fruit.centers[fruit])

    def radius(self, fruit: int) -> float:
        """Return the radius of a fruit, metres."""
        return float(self.fruit.radii[fruit])

    def joint(self, fruit: int) -> Array:
        """Return the presumed start (3,) of a fruit's pedicel."""
        return self.fruit.joint(fruit)

    def hanging(self) -> list[int]:
        """Return the fruit that hang."""
        hanging: list[int] = np.flatnonzero(self.fruit.hanging).tolist()
        return hanging

    def towards(self, twist: Twist) -> Array:
        """Return the change (j,) of the commands for a motion of the tip."""
        jacobian = np.concatenate([self._state.jacobian[0], self._state.joint_axes[0]])
        return joint_change(jacobian, twist, self.interval, self._problem.joint_steps)


class _Harvest:
    """Actions of an episode; each is decided when it is due, by what the hand has sensed until then."""

    def __init__(self, problem: Problem, hand: _SensedHand):
        self._problem, self._hand, self._robot = problem, hand, problem.robot
        self._tries: dict[int, int] = dict.fromkeys(problem.targets, 0)
        self._trail: list[Array] = []
        self._picked = 0

    def run(self) -> Iterator[Action]:
        """Yield the actions, at last without end."""
        hand = self._hand
        while True:
            left = [k for k, tries in self._tries.items() if tries < _TRIES and hand.fruit.hanging[k]]
            if not left:
                break
            tip, _ = hand.tip
            far = {k: float(np.linalg.norm(hand.center(k) - tip)) for k in left}
            fruit = min(left, key=lambda k: (self._tries[k], far[k]))
            yield from self._pick(fruit)
            self._tries[fruit] += 1
        while True:
            yield self._action(np.zeros(len(hand.command)), False)

    def _pick(self, fruit: int) -> Iterator[Action]:
        hand = self._hand
        hand.working, hand.parting = fruit, False
        for leaves, around in _SCENES:
            scene = self._scene(around)
            commands = self._commands(scene, fruit, self._robot, _GOALS, leaves)
            if commands is not None:
                break
        else:
            return
        self._trail = [hand.command, *commands]
        yield from self._follow(commands, False)
        for twist in close_gap(hand, fruit):
            yield self._action(hand.towards(twist), True)
        if not hand.holds:
            yield from self._go_back()
            return
        hand.begin(fruit)
        axes = list(turns(hand, fruit))
        for twist in part(hand, fruit, axes[self._tries[fruit] % len(axes)]):
            yield self._action(hand.towards(twist), True)
        yield from self._deliver(fruit)
        hand.parting = False

    def _deliver(self, fruit: int) -> Iterator[Action]:
        hand = self._hand
        loaded = with_fruit(self._robot, hand.radius(fruit))
        for attempt in range(_ATTEMPTS):
            directions = retreats(hand)
            for twist in withdraw(hand, directions[attempt % len(directions)]):
                yield self._action(hand.towards(twist), True)
            if not hand.holds:
                yield from self._go_back()
                return
            hand.fruit.hanging[fruit] = False
            scene, point = self._scene(0.0), self._above_crate()
            goals = pointing_down(hand.chain, self._robot, hand.command, point, self._problem.seed)
            for leaves in ("rigid", "brush"):
                commands = self._commands(scene, self._farthest(scene), loaded, goals, leaves)
                if commands is not None:
                    yield from self._follow(commands, True)
                    self._picked += hand.holds
                    for _ in range(_DROPS):
                        yield self._action(np.zeros(len(hand.command)), False)
                    return

    def _go_back(self) -> Iterator[Action]:
        """Go back some of the way on which the arm came."""
        yield from self._follow(self._trail[::-1][:_RETURN], False)

    def _above_crate(self) -> Array:
        return np.asarray(self._hand.crate + self._hand._turn @ np.append(spot(self._picked), _ABOVE))

    def _farthest(self, scene: Scene) -> int:
        tip, _ = self._hand.tip
        return int(np.argmax([np.linalg.norm(tomato.center - tip) for tomato in scene.tomatoes]))

    def _commands(
        self, scene: Scene, target: int, arm: Robot, goals: int | Array, leaves: str
    ) -> list[Array] | None:
        """Return the commands along a planned path; None without one."""
        hand, start = self._hand, np.clip(self._hand.command, arm.lower, arm.upper)
        seed = self._problem.seed + self._picked + 31 * max(self._tries.values())
        result = plan(
            scene, target, arm, time_limit=None, max_checks=_CHECKS, goals=goals, seed=seed, start=start, leaves=leaves
        )
        if result.path is None:
            return None
        kind = "brush" if leaves == "brush" and result.brushed_leaves else "rigid"
        return list(safe_commands(scene, target, result.path, replace(self._problem, robot=arm), kind))

    def _follow(self, commands: list[Array], vacuum: bool) -> Iterator[Action]:
        for command in commands:
            yield self._action(command - self._hand.command, vacuum)
            if vacuum and not self._hand.holds:
                return

    def _action(self, change: Array, vacuum: bool) -> Action:
        arm = np.clip(change / self._problem.joint_steps, -1, 1)
        return np.append(arm, 1.0 if vacuum else -1.0).astype(np.float32)

    def _scene(self, around: float) -> Scene:
        """Return the scan with its fruit where they are now, and the crate."""
        scene, fruit, crate = self._problem.scene, self._hand.fruit, self._problem.crate
        assert crate is not None
        tomatoes = []
        for k, tomato in enumerate(scene.tomatoes):
            # one that is off keeps its number, and is out of the way
            center = fruit.centers[k] if fruit.hanging[k] else np.array([0.0, 0.0, 9.0 + k])
            tomatoes.append(tomato.transformed(pose(translation=center - tomato.center)))
        turn = self._hand._turn
        middle = self._hand.crate - [0.0, 0.0, 2 * crate.half_extents[2]]
        boxes = [Box(turn @ at + middle, half + around, turn) for at, half in crate.boxes]
        clutter = (*scene.clutter, *boxes)
        return scene.model_copy(
            update={"tomatoes": tuple(tomatoes), "clutter": clutter, "targets": (), "truth": None, "occupancy": None}
        )
