"""An agent that harvests with the scan and the color camera at its wrist alone."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping
from itertools import repeat, takewhile
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import JointAgent, Problem, action_towards
from greenhouse_gym.agents.harvest.imagined_pick import choose_turn
from greenhouse_gym.agents.harvest.picking import (
    Twist,
    back_off,
    bring,
    close_gap,
    ease,
    feel,
    gently,
    lift,
    part,
    pointing_down,
    retreats,
    spot,
    with_fruit,
    withdraw,
    yielding,
)
from greenhouse_gym.agents.harvest.scanned_paths import Level, ScannedPaths
from greenhouse_gym.agents.harvest.scanned_stand import ScannedStand
from greenhouse_gym.agents.harvest.sensed_hand import SensedHand
from greenhouse_gym.envs.image_observations import RgbObservation
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, distance_to_nearest
from greenhouse_gym.rendering.cameras import DepthCamera

Action = npt.NDArray[np.float32]


IMAGE = (64, 48)
"""Width and height of the camera's images, pixels."""

_GOALS = 30  # configurations at a fruit
_LEVELS = (
    Level("rigid", 0.04, 0.012, True), Level("rigid", 0.04, 0.0, True), Level("rigid", 0.04, 0.0, False),
    Level("rigid", 0.0, 0.0, False), Level("brush", 0.04, 0.0, False), Level("brush", 0.0, 0.0, False),
)  # fmt: skip
_CARRIED = (
    Level("rigid", 0.02, 0.012, False), Level("rigid", 0.02, 0.0, False), Level("rigid", 0.0, 0.0, False),
    Level("rigid", 0.0, 0.0, False, False), Level("brush", 0.02, 0.0, False), Level("brush", 0.0, 0.0, False, False),
)  # on the way to the crate  # fmt: skip
_DELIVERIES = 12  # plans to the crate, in the latter half through leaves
_BLOCKED = 9.0  # N: pull at a held fruit that stops the arm on its way back
_RESISTED = 0.03  # radians: something unseen keeps a joint from where its servo pulls it; in free motion up to 0.02
_STOPPED = 4.0  # N: pull at a held fruit that stops the arm on its way to the crate
_FIRST = 4  # levels of the first try of a fruit
_PLANS, _LOOKS = 4, 2  # plans of an approach, and actions until it looks again for what is in its way
_JUMPS = 0.01, 0.05  # metres that a truss may jump as a fruit comes off, and that it is raised at most
_STILL = np.zeros(3), np.zeros(3)  # no motion of the tip
_TURNS, _RESTS = 2, 3  # ways to turn a fruit off, and actions at rest until its pull shows whether it is off
_TRIES = 3  # picks of a fruit before it is given up
_BACK = 10  # actions by which the arm goes back the way it came where there is no path
_CLEAR, _REACHED = 0.12, 0.01  # metres from plants at which the arm is clear of them; radians from a waypoint
_DROPS = 3  # actions to let go
_LIFTS = 6  # actions by which the arm goes back after it has let go
_SETTLES = 3  # actions at rest in front of a fruit
_CLOSING, _PRESSED = 0.05, 0.0012  # m/s to a fruit, and metres by which a tip deflects that presses with 5 N
_ABOVE = 0.02  # metres above the rim of the crate
_FEELS, _OFF = 0.02, 0.1  # metres: felt for a fruit, and backed off
_MOVED, _AWAY = 0.02, 0.09  # metres that a fruit has moved from a plan, and from the cup where it is not to be reached
_RELIEFS = 4  # actions at rest after commands went back to where the arm was


class ScanHarvester(JointAgent):
    """Pick the fruit that the scan shows one after the other, and follow them with the camera at the wrist.

    It plans in the scan to the nearest fruit, around what the camera sees and the scan lacks, closes the gap, turns the
    fruit gently about the presumed joint of its pedicel until the force at the wrist says that it is off, withdraws,
    yielding to whatever pulls at the fruit, and plans to the crate. Where there is no path it goes back the way it
    came. It never sees the true plants; which fruit are to be picked is a part of the problem.

    Args:
        name: Name in tables.
    """

    env_options: Mapping[str, Any] = MappingProxyType(
        {
            **JointAgent.env_options, "task": "harvest", "plants": "compliant", "physics": "truth",
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
        self._paths = ScannedPaths(problem, hand, self._stand)

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
        if not (yield from self._approach(fruit)):
            yield from self._retrace(False, _BACK)
            return
        for _ in range(_SETTLES):
            yield self._action(np.zeros(len(hand.command)), False)
        yield from self._move(takewhile(lambda _: self._gap(fruit) < _AWAY, close_gap(hand, fruit, _CLOSING)))
        if not hand.holds and hand.deflection <= _PRESSED and self._gap(fruit) < _FEELS / 2:
            yield from self._move(feel(hand, _FEELS, _CLOSING))
        if hand.holds:
            hand.begin(fruit)
            fruit = hand.working
            if (jump := hand.fruit.jump(fruit)) > _JUMPS[0]:
                yield from self._move(lift(hand, min(jump, _JUMPS[1])))
                hand.bear()
            yield from self._take_off(fruit)
        if hand.holds and not hand.fruit.hanging[fruit]:
            yield from self._deliver(fruit)
        else:
            yield from self._retrace(False)

    def _take_off(self, fruit: int) -> Iterator[Action]:
        """Turn a held fruit off and withdraw; one that pulls even then is brought back and turned another way."""
        hand, tried = self._hand, self._tries.get(fruit, 0)
        for attempt in range(tried, tried + _TURNS):
            hand.parting, before = True, hand.tip[0]
            axis, direction = choose_turn(hand, self._problem, self._stand, fruit, attempt)
            yield from self._move(part(hand, fruit, axis))
            yield from self._move(withdraw(hand, retreats(hand)[direction]))
            hand.parting = False
            yield from self._move(repeat(_STILL, _RESTS))
            if hand.holds and hand.pulls:
                hand.fruit.hang(fruit)
                yield from self._move(bring(hand, before))
            else:
                if hand.holds:
                    hand.fruit.pick(fruit)
                    hand.weigh()
                return

    def _gap(self, fruit: int) -> float:
        """Return the distance from the cup to a fruit as it is known, metres."""
        return float(np.linalg.norm(self._hand.center(fruit) - self._hand.tip[0])) - self._hand.radius(fruit)

    def _approach(self, fruit: int) -> Generator[Action, None, bool]:
        """Follow a path to a fruit, and plan again where the camera sees something in its way; return success."""
        for _ in range(_PLANS):
            for level in _LEVELS if self._tries[fruit] else _LEVELS[:_FIRST]:
                scene = self._stand.scene(level.around, level.apart, fruit, level.seen)
                commands = self._paths.commands(scene, fruit, self._robot, _GOALS, level)
                if commands is not None:
                    break
            else:
                return False
            if (yield from self._follow(commands, False, level, fruit)):
                return True
        return False

    def _deliver(self, fruit: int) -> Iterator[Action]:
        """Bring a fruit to the crate, as far as there is no path the way the arm came."""
        hand = self._hand
        loaded = with_fruit(self._robot, hand.radius(fruit))
        for attempt in range(_DELIVERIES):
            goals = pointing_down(hand.chain, self._robot, hand.command, self._above_crate(), self._problem.seed)
            for level in _CARRIED[:3] if attempt < _DELIVERIES // 2 else _CARRIED:
                scene = self._stand.scene(level.around, level.apart, seen=level.seen)
                commands = self._paths.commands(scene, self._paths.farthest(scene), loaded, goals, level)
                if commands is not None:
                    break
            if not hand.holds or (commands is not None and (yield from self._follow(commands, True, level))):
                break
            yield from self._retrace(True, _BACK)
        self._picked += hand.holds
        if hand.holds:
            for _ in range(_DROPS):
                yield self._action(np.zeros(len(hand.command)), False)
            yield from self._retrace(False, _LIFTS)

    def _retrace(self, vacuum: bool, actions: int | None = None) -> Iterator[Action]:
        """Go back the way the arm came until it is clear of the plants, or for a number of actions."""
        hand, plants = self._hand, self._stand.scene(0.0).arrays
        if hand.resisted > _RESISTED:  # give way once, and come to rest
            yield self._action(hand.joints - hand.command, vacuum)
            for _ in range(_RELIEFS):
                yield self._action(np.zeros(len(hand.command)), vacuum)
        if not self._trail:
            if not vacuum:
                yield from self._move(back_off(hand, _OFF, _CLOSING))
            return
        apart = np.abs(np.array(self._trail) - hand.command).max(axis=1)
        del self._trail[int(apart.argmin()) + 1 :]
        done = 0
        while self._trail and done != actions and hand.holds >= vacuum:
            tip, axis = hand.tip
            ahead = tip + axis * (hand.radius(hand.working) if vacuum else 0.0)
            if actions is None and distance_to_nearest(ahead[None], plants, 1.0)[0] > _CLEAR:
                return
            steps = self._problem.joint_steps
            change = ease(hand) * steps * action_towards(self._trail[-1], hand.command, steps)
            change += hand.towards((yielding(hand), np.zeros(3)))
            if np.abs(self._trail[-1] - hand.command).max() < _REACHED:
                self._trail.pop()
                continue
            done += 1
            stand = self._stand
            stopped = stand.stops(hand.command, change, close=True) or stand.nearer(hand.working, hand.command, change)
            if stopped or (vacuum and np.linalg.norm(hand.force) > _BLOCKED):
                return
            resisted = hand.resisted
            yield self._action(change, vacuum)
            if hand.resisted > max(resisted, _RESISTED):
                return

    def _above_crate(self) -> Array:
        return np.asarray(self._hand.crate + self._hand.turn @ np.append(spot(self._picked), _ABOVE))

    def _move(self, twists: Iterable[Twist]) -> Iterator[Action]:
        """Move the tip with vacuum, as far as the arm touches neither itself, nor its cart, the crate or a string."""
        hand = self._hand
        for twist in gently(hand, twists):
            change = hand.towards(twist)
            blocked = (hand.deflection > _PRESSED and not hand.holds) or hand.resisted > _RESISTED
            stand = self._stand
            if blocked or stand.stops(hand.command, change) or stand.nearer(hand.working, hand.command, change):
                return
            yield self._action(change, True)

    def _follow(
        self, commands: list[Array], vacuum: bool, level: Level, fruit: int = -1
    ) -> Generator[Action, None, bool]:
        """Follow commands until something is in the way, from which the arm goes back; return whether it gets there.

        Args:
            commands: The commands.
            vacuum: Whether a fruit is held: it stops where that is lost, or pressed on something.
            level: Caution by which it stops where the camera sees something in its way, or the fruit elsewhere.
            fruit: The fruit to which the path leads, if any.
        """
        center = self._hand.center(fruit)
        for k, command in enumerate(commands):
            if level.seen and k % _LOOKS == 0:
                moved = fruit >= 0 and np.linalg.norm(self._hand.center(fruit) - center) > _MOVED
                if moved or self._stand.blocks(np.array(commands[k::2]), level.leaves == "rigid"):
                    return False
            if self._stand.stops(self._hand.command, command - self._hand.command):
                return False
            self._trail.append(self._hand.command)
            yield self._action(command - self._hand.command, vacuum)
            if self._hand.resisted > _RESISTED:
                yield from self._retrace(vacuum, _BACK)
                return False
            if vacuum and (not self._hand.holds or np.linalg.norm(self._hand.force) > _STOPPED):
                return False
        return True

    def _action(self, change: Array, vacuum: bool) -> Action:
        arm = np.clip(change / self._problem.joint_steps, -1, 1)
        return np.append(arm, 1.0 if vacuum else -1.0).astype(np.float32)
