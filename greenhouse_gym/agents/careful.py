"""An agent that keeps out of what the scan did not see, as far as that goes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.guide import towards
from greenhouse_gym.envs.ways import Ends, Headings, Place, Ways
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.planning.unseen import depths_of, guarded
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene, compile_scene

CAREFUL_DEPTHS = (0.1, 0.15, 0.2, float("inf"))
"""How deep an arm may go into unseen space, metres. Without any of it there was no way to any of 15 tomatoes tried."""

_ONLY = np.zeros(1, dtype=np.int64)


def ends_of(problem: Problem, start: Array) -> Ends:
    """Configurations that reach the target of an episode, for an arm that is in one (j,) now, radians."""
    center = problem.scene.tomatoes[problem.target].center
    return Ends(compile_scene(problem.scene, problem.robot), problem.target, center, start)


def careful_ways(
    scene: Scene, robot: Robot, ends: Ends, depths: Sequence[float] = CAREFUL_DEPTHS
) -> tuple[Ways, float]:
    """The ways to a target that enter unseen space no deeper than they must.

    Args:
        scene: The scene as it is known by now.
        robot: The arm.
        ends: What reaches the target from where the arm is.
        depths: How deep the arm may go into unseen space, metres, in any order: the least that leaves a way counts.

    Returns:
        The ways, and the least depth at which they lead to the target, or the deepest; infinite where the scene does
        not say what was seen. Where the deepest leaves no way, those between are not searched.
    """

    def at(depth: float) -> tuple[Ways, float]:
        return Ways(Place(guarded(scene, robot, ends.start, depth)), ends), depth

    least, *more = [np.inf] if scene.seen is None else sorted(depths)
    found = at(least)
    if found[0].nodes.reach or not more:
        return found
    deepest = at(more[-1])
    if not deepest[0].nodes.reach:  # what lies between would be searched in vain
        return deepest
    return next((each for each in map(at, more[:-1]) if each[0].nodes.reach), deepest)


class CarefulAgent:
    """Follows the ways of ``observation="waypoint"``, looked for where the scan saw that there is room.

    What was not seen is entered no deeper than the least of some depths that leaves a way to the target; at the deepest
    of the usual ones it is as free as it is to an arm that does not care.
    It needs an environment whose actions move the joints.

    Args:
        depths: How deep the arm may go into unseen space, metres, in any order.

    Attributes:
        status: How deep it was in the last episode, metres: "inf" where the unseen is free, as in a scene that does not
            say what was seen of it.

    Raises:
        InvalidValueError: There is no depth, or a negative one.
    """

    name = "careful"
    env_options: Mapping[str, Any] = MappingProxyType({})

    def __init__(self, depths: Sequence[float] = CAREFUL_DEPTHS):
        self.status = ""
        self._depths = tuple(depth for each in depths for depth in depths_of(float(each)))
        if not self._depths:
            raise InvalidValueError("depths: expected at least one depth in metres, got none")
        self._headings = Headings(1, 0)
        self._command = self._steps = np.zeros(0)
        self._age = 0

    def reset(self, problem: Problem) -> None:
        """Look for a way."""
        ends = ends_of(problem, problem.start)
        ways, depth = careful_ways(problem.scene, problem.robot, ends, self._depths)
        self.status = f"{depth:g}"
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
