"""A teacher: at any configuration it knows the shortest way to a target, and always the same one.

Of many goal configurations it goes straight for the nearest one to which the straight motion is free; where there is
none, it goes for the best node of paths that RRTConnect found. What it does depends on where the arm is and on nothing
else, which is what makes it fit to be imitated: a planner that is asked twice gives two paths, and their mean is none.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.goals import search_goals
from greenhouse_gym.motion.inverse_kinematics import inverse_kinematics
from greenhouse_gym.motion.reach import joint_reaches
from greenhouse_gym.planning import CollisionChecker, planning_model, resample
from greenhouse_gym.planning.query import plan_with
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import tool_chain
from greenhouse_gym.scene import CompiledScene, compile_scene

MARGINS = (0.012, 0.004, 0.0)
"""Distances to obstacles that are kept, metres: the next one where there is no way with the one before."""

RESOLUTION = 0.03
"""How far any point of the arm may move between two checks, metres."""

GUESSES, SPREADS = 64, (0.4, 1.2)
"""First guesses of goals, and how far they are strewn about the start, radians."""

PLANS, PLAN_CHECKS, NEAREST = 4, 6_000, 60
"""Runs of RRTConnect in an episode, where no straight motion is free, the checks of each, and the goals it gets."""

SPACING = 0.25
"""Largest change of a joint between two nodes of a path, radians."""

REACHED = 0.1
"""How near a node of a path counts as reached, radians."""


class Guide:
    """The way to one target from anywhere.

    Args:
        compiled: The scene with its arm.
        target: Index of the target.
        start: (joints,) near which goals are looked for, radians.
        seed: Same seed, same result.

    Attributes:
        nodes: (k, joints) goals and nodes of paths to them, radians.
        costs: (k,) way from each to its goal, radians.
    """

    def __init__(self, compiled: CompiledScene, target: int, start: Array, seed: int = 0):
        self._compiled, self._target, self._seed = compiled, target, seed
        self._checkers = tuple(
            CollisionChecker(planning_model(compiled, target, margin=margin), _reaches(compiled)) for margin in MARGINS
        )
        arm, tomato = compiled.robot, compiled.scene.tomatoes[target]
        random = np.random.default_rng(seed)
        chain = tool_chain(compiled.model, compiled.tip_site)

        strewn = random.normal(size=(GUESSES, len(start))) * np.linspace(*SPREADS, GUESSES)[:, None]
        guesses = np.clip(start + strewn, arm.lower, arm.upper)
        guesses[:, -1] = start[-1]  # the tool is round
        found = inverse_kinematics(chain, guesses, tomato.center, tomato.radius, arm)
        self.nodes = found[[self._checkers[-1].is_free(end) for end in found]].reshape(-1, len(start))
        if not len(self.nodes):
            self.nodes = search_goals(compiled, self._checkers[-1], target, seed=seed).configurations
        self.costs = np.zeros(len(self.nodes))
        self._ends = self.nodes
        self._plans = 0

    def waypoint(self, joints: Array) -> Array | None:
        """(joints,) where to go straight from here, radians; None where no way is known."""
        for checker in self._checkers:
            if len(self.nodes) and checker.is_free(joints):
                found = self._visible(checker, joints)
                if found is None and self._plans < PLANS:
                    found = self._planned(checker, joints)
                if found is not None:
                    return found
        return None

    def _visible(self, checker: CollisionChecker, joints: Array) -> Array | None:
        """The best node to which the straight motion is free."""
        ways = np.linalg.norm(self.nodes - joints, axis=1)
        ways[len(self._ends) :][ways[len(self._ends) :] < REACHED] = np.inf
        for k in np.argsort(ways + self.costs):
            if np.isfinite(ways[k]) and checker.motion_is_free(joints, self.nodes[k], RESOLUTION):
                return np.asarray(self.nodes[k])
        return None

    def _planned(self, checker: CollisionChecker, joints: Array) -> Array | None:
        """The next node of a path that RRTConnect finds; the others are kept for later."""
        goals = self._ends
        nearest = goals[np.linalg.norm(goals - joints, axis=1).argsort()[:NEAREST]]
        self._plans += 1
        result = plan_with(
            self._compiled, checker, nearest, "RRTConnect", None, PLAN_CHECKS, self._seed + self._plans, joints,
        )  # fmt: skip
        if result.path is None:
            return None
        path = resample(result.path, SPACING)
        left = np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)[::-1])[::-1]
        self.nodes = np.concatenate([self.nodes, path[1:-1]])
        self.costs = np.concatenate([self.costs, left[1:]])
        return np.asarray(path[1])


def towards(waypoint: Array, command: Array, steps: Array) -> Array:
    """The action (joints,) in [-1, 1] that moves a command straight towards a waypoint, as fast as may be."""
    wish = (waypoint - command) / steps
    return np.asarray(wish / max(1.0, float(np.abs(wish).max())))


_REACHES: dict[int, tuple[Robot, Array]] = {}


def _reaches(compiled: CompiledScene) -> Array:
    """`joint_reaches` of the arm, computed once."""
    arm = compiled.robot
    if id(arm) not in _REACHES:
        _REACHES[id(arm)] = arm, joint_reaches(compiled.model)  # the arm is kept, and with it its identity
    return _REACHES[id(arm)][1]


class GuidedAgent:
    """Does at every step what the teacher would: the bound of what can be learned from it.

    It needs an environment whose actions move the joints.

    Args:
        every: Steps after which the way is looked for anew.
    """

    name = "guide"
    env_options: Mapping[str, Any] = MappingProxyType({})

    def __init__(self, every: int = 4):
        self._every = every
        self._guide: Guide | None = None
        self._command = self._steps = np.zeros(0)
        self._waypoint: Array | None = None
        self._age = 0

    def reset(self, problem: Problem) -> None:
        """Find the goals."""
        compiled = compile_scene(problem.scene, problem.robot)
        self._guide = Guide(compiled, problem.target, problem.start, problem.seed)
        self._command, self._steps = problem.start.copy(), problem.joint_steps
        self._waypoint, self._age = None, 0

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """A step towards the waypoint; zero where there is none."""
        if self._guide is None:
            raise RuntimeError("reset the agent before it acts")
        if self._age % self._every == 0:
            self._waypoint = self._guide.waypoint(self._command)
        self._age += 1
        if self._waypoint is None:
            return np.zeros(len(self._steps), dtype=np.float32)
        action = towards(self._waypoint, self._command, self._steps)
        self._command = self._command + action * self._steps
        return action.astype(np.float32)
