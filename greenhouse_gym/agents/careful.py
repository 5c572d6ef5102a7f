"""An agent that keeps out of what the scan did not see, as far as that goes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.guide import towards
from greenhouse_gym.envs.waypoints import Ends, Headings, Place, Ways
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.margins import with_margin
from greenhouse_gym.motion.unexplained_cells import unexplained_cells, with_unexplained_cells
from greenhouse_gym.motion.unknown_space import depths_of, guarded
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene, compile_scene

CAREFUL_DEPTHS = (0.1, 0.15, 0.2, float("inf"))
"""How deep an arm may go into unknown space, metres. Without any of it there was no way to any of 15 tomatoes tried."""


class Care(NamedTuple):
    """How careful a way is.

    Attributes:
        margin: How far the arm keeps from boxes of clutter, metres; see `greenhouse_gym.motion.margins`.
        depth: How deep it goes into unknown space at most, metres.
        unexplained: Whether it keeps out of where the scan saw a surface without a shape; see
            `greenhouse_gym.motion.unexplained_cells`.
    """

    margin: float
    depth: float
    unexplained: bool = False


_ONLY = np.zeros(1, dtype=np.int64)


def ends_of(problem: Problem, start: Array) -> Ends:
    """Configurations that reach the target of an episode, for an arm that is in one (j,) now, radians."""
    center = problem.scene.tomatoes[problem.target].center
    return Ends(compile_scene(problem.scene, problem.robot), problem.target, center, start)


def careful_ways(scene: Scene, robot: Robot, ends: Ends, cares: Sequence[Care]) -> tuple[Ways, Care]:
    """The ways to a target that are as careful as can be.

    Args:
        scene: The scene as it is known by now.
        robot: The arm.
        ends: What reaches the target from where the arm is.
        cares: What is tried, the most careful first; the last should ask least. In a scene that does not say what was
            seen of it, all unknown space is free to each of them.

    Returns:
        The ways, and the first care with which they lead to the target, or the last. Where the last leaves no way,
        those between are not searched.
    """

    def by(care: Care) -> tuple[Ways, Care]:
        return Ways(Place(guarded(cared(scene, robot, ends.start, care), robot, ends.start, care.depth)), ends), care

    if scene.occupancy is None:
        cares = [care._replace(depth=np.inf) for care in cares]
    if not unexplained_cells(scene).any():
        cares = [care._replace(unexplained=False) for care in cares]
    first, *more = dict.fromkeys(cares)
    found = by(first)
    if found[0].nodes.reach or not more:
        return found
    last = by(more[-1])
    if not last[0].nodes.reach:  # what lies between would be searched in vain
        return last
    return next((each for each in map(by, more[:-1]) if each[0].nodes.reach), last)


def cared(scene: Scene, robot: Robot, start: Array, care: Care) -> Scene:
    """A scene for a way from one configuration (j,): with its margin, and with surfaces where it heeds them."""
    roomy = with_margin(scene, robot, start, care.margin)
    return with_unexplained_cells(roomy, robot, start) if care.unexplained else roomy


class CarefulAgent:
    """Follows the ways of ``observation="waypoint"``, looked for where the scan saw that there is room.

    What was not seen is entered no deeper than the least of some depths that leaves a way to the target; at the deepest
    of the usual ones it is as free as it is to an arm that does not care.
    It needs an environment whose actions move the joints.

    Args:
        depths: How deep the arm may go into unknown space, metres, in any order.

    Attributes:
        status: How deep it was in the last episode, metres: "inf" where unknown space is free, as in a scene without
            an occupancy grid.

    Raises:
        InvalidValueError: There is no depth, or a negative one.
    """

    name = "careful"
    env_options: Mapping[str, Any] = MappingProxyType({})

    def __init__(self, depths: Sequence[float] = CAREFUL_DEPTHS):
        self.status = ""
        self._cares = [Care(0.0, depth) for each in sorted(depths) for depth in depths_of(float(each))]
        if not self._cares:
            raise InvalidValueError("depths: expected at least one depth in metres, got none")
        self._headings = Headings(1, 0)
        self._command = self._steps = np.zeros(0)
        self._age = 0

    def reset(self, problem: Problem) -> None:
        """Look for a way."""
        ends = ends_of(problem, problem.start)
        ways, care = careful_ways(problem.scene, problem.robot, ends, self._cares)
        self.status = f"{care.depth:g}"
        self._headings = Headings(1, len(problem.start))
        self._headings.begin(0, ways)
        self._command, self._steps, self._age = problem.start.copy(), problem.joint_steps, 0

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """A step towards the waypoint; zero while there is no free way to one."""
        if not len(self._steps):
            raise RuntimeError("reset the agent before it acts")
        self._headings.look(_ONLY, self._command[None], np.array([self._age]))
        self._age += 1
        action = towards(self._headings.waypoint[0], self._command, self._steps) * self._headings.way[0, 1]
        self._command = self._command + action * self._steps
        return action.astype(np.float32)
