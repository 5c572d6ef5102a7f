"""An agent that keeps out of what the scan did not see, as far as that goes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf, isfinite
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.guide import towards
from greenhouse_gym.envs.ways import Ends, Headings, Place, Ways
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.planning.unseen import guarded
from greenhouse_gym.scene import compile_scene

CARE = ((0.1, 0.015), (0.15, 0.015), (0.2, 0.015), (0.2, 0.004), (inf, 0.015), (inf, 0.004))
"""How deep an arm may go into unseen space and how far it keeps from things, metres: what is tried, one by one."""

_ONLY = np.zeros(1, dtype=np.int64)


class CarefulAgent:
    """Follows the ways of ``observation="waypoint"``, looked for where the scan saw that there is room.

    What was not seen is entered no deeper, and things are passed no nearer, than each of some pairs of distances
    allows, one after the other: the first of these that leaves a way to the target is what counts in the episode.
    It needs an environment whose actions move the joints.

    Args:
        care: How deep the arm may go into unseen space, and how far it keeps from all that is known, metres. Where a
            scene does not say what was seen of it, only the second counts.

    Attributes:
        status: What counted in the last episode.

    Raises:
        InvalidValueError: There is no such pair, or a negative distance.
    """

    name = "careful"
    env_options: Mapping[str, Any] = MappingProxyType({})

    def __init__(self, care: Sequence[tuple[float, float]] = CARE):
        if not care or not all(depth >= 0 and margin >= 0 for depth, margin in care):
            raise InvalidValueError(f"care: expected pairs of distances of 0 m or more, got {list(care)!r}")
        self.status = ""
        self._care = tuple(care)
        self._headings = Headings(1, 0)
        self._command = self._steps = np.zeros(0)
        self._age = 0

    def reset(self, problem: Problem) -> None:
        """Look for a way."""
        center = problem.scene.tomatoes[problem.target].center
        ends = Ends(compile_scene(problem.scene, problem.robot), problem.target, center, problem.start)
        for depth, margin in self._care:
            allowed = inf if problem.scene.seen is None else depth
            ways = Ways(Place(guarded(problem.scene, problem.robot, problem.start, allowed)), ends, margin)
            if ways.nodes.reach:
                break
        self.status = f"{f'unseen to {allowed:g} m' if isfinite(allowed) else 'unseen free'}, {margin:g} m kept"
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
