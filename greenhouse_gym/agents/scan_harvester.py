"""An agent that harvests with the scan and the color camera at its wrist alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import NamedAgent, Problem, action_towards
from greenhouse_gym.agents.picking import (
    Twist,
    close_gap,
    part,
    pointing_down,
    retreats,
    spot,
    turns,
    with_fruit,
    withdraw,
)
from greenhouse_gym.agents.planner_agent import default_margin, default_unknown, safe_commands
from greenhouse_gym.agents.scanned_stand import ScannedStand
from greenhouse_gym.agents.sensed_hand import ImaginedHand, SensedHand
from greenhouse_gym.envs.image_observations import RgbObservation
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, arrays_of, distance_to_nearest
from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.planning import plan
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import tool_state
from greenhouse_gym.scene import Scene

Action = npt.NDArray[np.float32]


class _Level(NamedTuple):
    """Caution of a plan.

    Attributes:
        leaves: How leaves count, see `greenhouse_gym.planning.plan`.
        around: Metres by which the crate is thickened.
        apart: Metres by which fruit except the target, and stems, are thickened.
        cautious: Keep away from leaves and out of space that the scan did not see.
    """

    leaves: str
    around: float
    apart: float
    cautious: bool


IMAGE = (64, 48)
"""Width and height of the camera's images, pixels."""

_CHECKS, _GOALS = 40_000, 30  # collision checks of a plan, and configurations at a fruit
_LEVELS = (
    _Level("rigid", 0.04, 0.012, True), _Level("rigid", 0.04, 0.0, True), _Level("rigid", 0.04, 0.0, False),
    _Level("brush", 0.04, 0.0, False), _Level("brush", 0.0, 0.0, False),
)  # fmt: skip
_FIRST = 3  # levels of the first try of a fruit
_TRIES = 3  # picks of a fruit before it is given up
_BACK = 10  # actions by which the arm goes back the way it came where there is no path
_CLEAR, _REACHED = 0.12, 0.01  # metres from plants at which the arm is clear of them; radians from a waypoint
_DROPS = 3  # actions to let go
_KEPT, _LARGEST = 0.008, 0.1  # metres that turning and withdrawing keep from known fruit and stems; largest radius
_LIFTS = 6  # actions by which the arm goes back after it has let go
_ABOVE = 0.02  # metres above the rim of the crate


class ScanHarvester(NamedAgent):
    """Pick the fruit that the scan shows one after the other, and follow them with the camera at the wrist.

    It plans in the scan to the nearest fruit, closes the gap by what the camera sees of it, turns it about the presumed
    joint of its pedicel until the force at the wrist says that it is off, withdraws, and plans to the crate. It never
    sees the true plants; which fruit are to be picked is a part of the problem.

    Args:
        name: Name in tables.
    """

    takes_other_actions = True
    env_options: Mapping[str, Any] = MappingProxyType(
        {
            "task": "harvest", "plants": "compliant", "physics": "truth", "action": "joint",
            "observation": RgbObservation(DepthCamera("wrist", *IMAGE), depth=True),
        }
    )  # fmt: skip

    def __init__(self, name: str = "harvest-scan"):
        self.name, self.status = name, ""
        self._hand: SensedHand | None = None
        self._script: Iterator[Action] = iter(())

    def reset(self, problem: Problem) -> None:
        """Begin an episode.

        Raises:
            InvalidValueError: The environment has another task.
        """
        if problem.crate is None:
            raise InvalidValueError(f'agent {self.name!r} needs task="harvest"')
        self.status, self._hand = "", SensedHand(problem, IMAGE)
        self._script = _Harvest(problem, self._hand).run()

    def act(self, observation: Any) -> Action:
        """Return the next action."""
        if self._hand is None:
            raise RuntimeError("reset the agent before it acts")
        self._hand.sense(observation)
        return next(self._script)


class _Harvest:
    """Actions of an episode; each is decided when it is due, by what the hand has sensed until then."""

    def __init__(self, problem: Problem, hand: SensedHand):
        self._problem, self._hand, self._robot = problem, hand, problem.robot
        self._tries: dict[int, int] = dict.fromkeys(problem.targets, 0)
        self._trail: list[Array] = []
        self._picked = 0
        self._stand = ScannedStand(problem, hand)

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
        for level in _LEVELS if self._tries[fruit] else _LEVELS[:_FIRST]:
            scene = self._stand.scene(level.around, level.apart, fruit)
            commands = self._commands(scene, fruit, self._robot, _GOALS, level)
            if commands is not None:
                break
        else:
            yield from self._retrace(False, _BACK)
            return
        yield from self._follow(commands, False)
        yield from self._move(close_gap(hand, fruit))
        if hand.holds:
            hand.begin(fruit)
            axis, direction = self._choose(fruit)
            yield from self._move(part(hand, fruit, axis))
            yield from self._move(withdraw(hand, retreats(hand)[direction]))
            hand.parting = False
        if hand.holds:
            hand.fruit.hanging[fruit] = False
            yield from self._deliver(fruit)
        else:
            yield from self._retrace(False)

    def _choose(self, fruit: int) -> tuple[Array, int]:
        """Return the axis to turn a held fruit about and the number of the direction to withdraw in.

        Both are imagined among the fruit and stems that are known; the choice keeps most away from them, and gets
        worse with every try.
        """
        hand, scene = self._hand, self._stand.scene(0.0)
        others = [tomato for k, tomato in enumerate(scene.tomatoes) if k != fruit]
        near = arrays_of([*(tomato.shape for tomato in others), *scene.stems])
        arm = arm_spheres(self._robot)
        costs: list[tuple[float, int, Array, int]] = []
        for axis in turns(hand, fruit):
            for direction in range(len(retreats(hand))):
                imagined = ImaginedHand(hand, self._problem)
                imagined.move(part(imagined, fruit, axis))
                imagined.move(withdraw(imagined, retreats(imagined)[direction]))
                path = np.array(imagined.path)
                links = arm.centers(path)[:, arm.moving] @ hand.turn.T + hand.base
                state = tool_state(hand.chain, path)
                held = state.point + hand.radius(fruit) * state.axis
                gaps = distance_to_nearest(links.reshape(-1, 3), near, _KEPT + _LARGEST).reshape(links.shape[:2])
                gap = np.append(
                    (gaps - arm.radius[arm.moving]).min(axis=1),
                    distance_to_nearest(held, near, _KEPT + _LARGEST) - hand.radius(fruit),
                )
                stopped = not all(self._stand.is_free(q) for q in path)
                costs.append((float(np.maximum(_KEPT - gap, 0.0).sum()) + stopped, len(costs), axis, direction))
        costs.sort(key=lambda cost: cost[:2])
        *_, axis, direction = costs[min(self._tries[fruit], len(costs) - 1)]
        return axis, direction

    def _deliver(self, fruit: int) -> Iterator[Action]:
        """Bring a fruit back the way the arm came, and from there to the crate."""
        hand = self._hand
        loaded, scene = with_fruit(self._robot, hand.radius(fruit)), self._stand.scene(0.0)
        level = _Level("rigid", 0.0, 0.0, False)
        yield from self._retrace(True)
        while hand.holds:
            goals = pointing_down(hand.chain, self._robot, hand.command, self._above_crate(), self._problem.seed)
            commands = self._commands(scene, self._farthest(scene), loaded, goals, level)
            if commands is not None:
                yield from self._follow(commands, True)
                break
            if len(self._trail) < 2:
                break
            yield from self._retrace(True, _BACK)
        self._picked += hand.holds
        if hand.holds:
            for _ in range(_DROPS):
                yield self._action(np.zeros(len(hand.command)), False)
            yield from self._retrace(False, _LIFTS)

    def _retrace(self, vacuum: bool, steps: int | None = None) -> Iterator[Action]:
        """Go back the way the arm came until it is clear of the plants, or for a number of actions."""
        hand, plants = self._hand, self._stand.scene(0.0).arrays
        if not self._trail:
            return
        apart = np.abs(np.array(self._trail) - hand.command).max(axis=1)
        del self._trail[int(apart.argmin()) + 1 :]
        done = 0
        while self._trail and done != steps and hand.holds >= vacuum:
            tip, axis = hand.tip
            ahead = tip + axis * (hand.radius(hand.working) if vacuum else 0.0)
            if steps is None and distance_to_nearest(ahead[None], plants, 1.0)[0] > _CLEAR:
                return
            action = action_towards(self._trail[-1], hand.command, self._problem.joint_steps)
            if np.abs(self._trail[-1] - hand.command).max() < _REACHED:
                self._trail.pop()
                continue
            done += 1
            yield np.append(action, 1.0 if vacuum else -1.0).astype(np.float32)

    def _above_crate(self) -> Array:
        return np.asarray(self._hand.crate + self._hand.turn @ np.append(spot(self._picked), _ABOVE))

    def _farthest(self, scene: Scene) -> int:
        tip, _ = self._hand.tip
        return int(np.argmax([np.linalg.norm(tomato.center - tip) for tomato in scene.tomatoes]))

    def _commands(self, scene: Scene, target: int, arm: Robot, goals: int | Array, level: _Level) -> list[Array] | None:
        """Return the commands along a planned path; None without one."""
        start = np.clip(self._hand.command, arm.lower, arm.upper)
        seed = self._problem.seed + self._picked + 31 * max(self._tries.values())
        scan = self._problem.scene
        unknown, margin = (default_unknown(scan), default_margin(scan)) if level.cautious else ("free", 0.0)
        result = plan(
            scene, target, arm, time_limit=None, max_checks=_CHECKS, goals=goals, seed=seed, start=start,
            unknown=unknown, margin=margin, leaves=level.leaves,
        )  # fmt: skip
        if result.path is None:
            return None
        kind = "brush" if level.leaves == "brush" and result.brushed_leaves else "rigid"
        return list(safe_commands(scene, target, result.path, replace(self._problem, robot=arm), kind))

    def _move(self, twists: Iterator[Twist]) -> Iterator[Action]:
        """Move the tip with vacuum, as far as the arm touches neither itself, nor its cart, the crate or a string."""
        hand = self._hand
        for twist in twists:
            change = hand.towards(twist)
            if not self._stand.is_free(hand.command + change):
                return
            yield self._action(change, True)

    def _follow(self, commands: list[Array], vacuum: bool) -> Iterator[Action]:
        for command in commands:
            self._trail.append(self._hand.command)
            yield self._action(command - self._hand.command, vacuum)
            if vacuum and not self._hand.holds:
                return

    def _action(self, change: Array, vacuum: bool) -> Action:
        arm = np.clip(change / self._problem.joint_steps, -1, 1)
        return np.append(arm, 1.0 if vacuum else -1.0).astype(np.float32)
