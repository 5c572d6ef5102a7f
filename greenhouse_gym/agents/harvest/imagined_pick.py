"""Turns and withdrawals that an arm imagines before it takes a held fruit off."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.harvest.picking import Twist, joint_change, part, retreats, turns, withdraw
from greenhouse_gym.agents.harvest.scanned_stand import ScannedStand
from greenhouse_gym.agents.harvest.sensed_hand import SensedHand
from greenhouse_gym.geometry import Array, arrays_of, distance_to_nearest
from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.robots.kinematics import tool_state

_PARTS = 11  # actions after which an imagined fruit comes off
_KEPT, _LARGEST = 0.008, 0.1  # metres that turning and withdrawing keep from known fruit and stems; largest radius


class ImaginedHand:
    """Hand that moves without resistance; its fruit comes off after some actions.

    Args:
        hand: The hand as it is, with the fruit in work.
        problem: The episode.
    """

    def __init__(self, hand: SensedHand, problem: Problem):
        self._hand, self._problem, self.interval = hand, problem, hand.interval
        self.held, self.force = hand.working, np.zeros(3)
        self.joint, self.radius = hand.joint, hand.radius
        self.path = [hand.command]

    @property
    def tip(self) -> tuple[Array, Array]:
        """Position (3,) and direction (3,) of the tool in the scene."""
        state = tool_state(self._hand.chain, self.path[-1][None])
        return state.point[0], state.axis[0]

    def center(self, fruit: int) -> Array:
        """Return the middle (3,) of a fruit; the one in work is at the cup."""
        if fruit != self.held:
            return self._hand.center(fruit)
        tip, axis = self.tip
        return np.asarray(tip + self.radius(fruit) * axis)

    def hanging(self) -> list[int]:
        """Return the fruit that hang."""
        return [k for k in self._hand.hanging() if k != self.held or len(self.path) <= _PARTS]

    def move(self, twists: Iterable[Twist]) -> None:
        """Move the tip, one motion an action."""
        for twist in twists:
            state = tool_state(self._hand.chain, self.path[-1][None])
            jacobian = np.concatenate([state.jacobian[0], state.joint_axes[0]])
            change = joint_change(jacobian, twist, self.interval, self._problem.joint_steps)
            self.path.append(self.path[-1] + change)


def choose_turn(hand: SensedHand, problem: Problem, stand: ScannedStand, fruit: int, tried: int) -> tuple[Array, int]:
    """Return the axis (3,) to turn a held fruit about and the number of the direction to withdraw in.

    Both are imagined among the fruit and stems that are known; the choice keeps most away from them, and gets worse
    with every try.

    Args:
        hand: The hand with the fruit.
        problem: The episode.
        stand: The stand as it is known.
        fruit: The fruit.
        tried: Number of tries before.
    """
    scene, arm = stand.scene(0.0), arm_spheres(problem.robot)
    others = [tomato for k, tomato in enumerate(scene.tomatoes) if k != fruit]
    near = arrays_of([*(tomato.shape for tomato in others), *scene.stems])
    costs: list[tuple[float, int, Array, int]] = []
    for axis in turns(hand, fruit):
        for direction in range(len(retreats(hand))):
            imagined = ImaginedHand(hand, problem)
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
            stopped = not all(stand.is_free(q) for q in path)
            costs.append((float(np.maximum(_KEPT - gap, 0.0).sum()) + stopped, len(costs), axis, direction))
    costs.sort(key=lambda cost: cost[:2])
    *_, axis, direction = costs[min(tried, len(costs) - 1)]
    return axis, direction
