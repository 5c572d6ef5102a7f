"""An agent that plans once at the start of an episode and follows its path."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import JointAgent, Problem
from greenhouse_gym.envs.actions import INTERVAL, joint_steps
from greenhouse_gym.errors import check_flag, check_whole, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import LEAVES
from greenhouse_gym.motion.unknown_space import guarded
from greenhouse_gym.planning import PLANNERS, PlanResult, follow_path, free_commands, plan
from greenhouse_gym.scene import Scene

Level: TypeAlias = tuple[float, str | float]
"""Margin, metres, and rule for unknown space, as `greenhouse_gym.planning.plan` takes them."""

MAX_DEPTH = 0.15
"""Default depth of planned paths in unknown space, metres: the leaves that paths hit hang deeper in it."""

COVERING_PROTOCOLS = ("upright-back",)
"""Protocols that observe the leaves over the aisle: paths through unknown space held there, and without it many
tomatoes had no path."""

LEAF_MARGIN = 0.01
"""Default distance of planned paths from boxes of leaves, metres; see `greenhouse_gym.motion.caution.with_margin`."""

ATTEMPTS = 4
"""Default number of plans without any caution, each with another seed."""


def default_unknown(scene: Scene) -> str | float:
    """Return the default rule for unknown space in a scene, as `greenhouse_gym.planning.plan` takes it."""
    return "free" if scene.occupancy is None or scene.provenance.protocol in COVERING_PROTOCOLS else MAX_DEPTH


def default_margin(scene: Scene) -> float:
    """Return the default distance of paths from boxes of clutter in a scene, metres.

    Boxes whose number follows the area of the foliage are thin, and leaves reach beyond them. Boxes of older scenes are
    thick already where leaves are dense; nothing is known about boxes from elsewhere.
    """
    shapes = scene.provenance.settings.get("shapes")
    return LEAF_MARGIN if isinstance(shapes, dict) and "clutter_per_area" in shapes else 0.0


def fallback_levels(scene: Scene) -> list[Level]:
    """Return margins and rules for unknown space to plan with in turn, the most cautious first."""
    margin, unknown = default_margin(scene), default_unknown(scene)
    return list(dict.fromkeys([(margin, unknown), (margin, "free"), (margin / 2, "free"), (0.0, "free")]))


def path_commands(path: Array, problem: Problem) -> Array:
    """Return the commands (steps, joints) along a path from the current configuration, within the arm's limits.

    Raises:
        InvalidValueError: The environment's actions do not move the joints.
    """
    return follow_path(*_limits(path, problem), lag=problem.robot.lag)


def safe_commands(scene: Scene, target: int, path: Array, problem: Problem, leaves: str = LEAVES[0]) -> Array:
    """Return the commands along a path that was planned in a scene, proven free between them; see `path_commands`."""
    compiled = guarded(scene, problem.robot, path[0], np.inf)  # as planned with
    return free_commands(compiled, target, *_limits(path, problem), leaves=leaves)


def _limits(path: Array, problem: Problem) -> tuple[Array, Array, Array, float]:
    """Return a path with limits on speed and acceleration, and the time between commands."""
    robot, steps, interval = problem.robot, problem.joint_steps, problem.interval
    speed = np.minimum(np.minimum(robot.velocity_limits, steps / interval), joint_steps(robot) / INTERVAL)
    return path, speed, robot.acceleration_limits, interval


class PathFollower:
    """Actions of the environment along a joint path, followed by zero actions.

    Args:
        path: (k, joints) radians, from the current configuration.
        problem: The episode; its arm's limits on speed and acceleration apply, and its action rule.
        proven: Whether the path is proven free, and the commands must be as well; see `free_commands`.
        leaves: "brush" if the path may touch leaves.

    Attributes:
        commands: (steps, joints) command after each action, radians.

    Raises:
        InvalidValueError: The environment's actions do not move the joints.
    """

    def __init__(self, path: Array, problem: Problem, proven: bool = False, leaves: str = LEAVES[0]):
        steps = problem.joint_steps
        self.commands = (
            safe_commands(problem.scene, problem.target, path, problem, leaves)
            if proven
            else path_commands(path, problem)
        )
        self._actions = iter(np.diff(self.commands, axis=0, prepend=path[:1]) / steps)
        self._zero = np.zeros(len(steps))

    def action(self) -> npt.NDArray[np.float32]:
        """Return the next action, (joints,) in [-1, 1]."""
        return next(self._actions, self._zero).astype(np.float32)


class PlannerAgent(JointAgent):
    """Plan with any planner and follow the path; hold still without a path.

    By default it plans cautiously: away from leaves, and not deep into unknown space. Where no such path exists, or
    none that the arm can follow within the episode, it falls back step by step to the known shapes alone, see
    `fallback_levels`.

    It needs an environment whose actions move the joints: increments or velocities.

    Args:
        planner: A name in `greenhouse_gym.planning.PLANNERS`.
        time_limit: Seconds the planner may search, or None: with a limit, the result depends on the machine's load.
        max_checks: Collision checks of each plan, or None; the default takes some seconds.
        goals: Number of goal configurations.
        name: Name in tables; the planner's name when left out.
        settings: Parameters of the planner to change, as `greenhouse_gym.planning.plan` takes them.
        unknown: Rule for space that the scan did not observe, as `greenhouse_gym.planning.plan` takes it. When left
            out, paths first enter it no deeper than `MAX_DEPTH`; it is free if the scene has no occupancy or its
            protocol is one of `COVERING_PROTOCOLS`.
        margin: Distance from boxes of clutter, metres, as `greenhouse_gym.planning.plan` takes it. When left out,
            first `LEAF_MARGIN` in scenes whose boxes follow the area of the foliage, as scenes are built now, and 0 in
            others.
        attempts: Largest number of plans with the least caution, each with another seed.
        unexplained: Whether it avoids unexplained occupied cells, in scenes with occupancy; see
            `greenhouse_gym.motion.caution.with_unexplained_cells`.
        fallback: Whether it becomes less cautious where it must. Without, it holds still there. A margin or a rule for
            unknown space that is given never changes.
        leaves: "rigid", or "brush" to plan through leaves where no path leads around them, as
            `greenhouse_gym.planning.plan` takes it. When left out, it brushes leaves where the episode lets them yield.

    Attributes:
        result: The last episode's plan; None before the first.
        level: Margin and rule for unknown space of that plan.

    Raises:
        UnknownNameError: No such planner, or no such parameter of it.
        InvalidValueError: The attempts are not a whole number of 1 or more.
    """

    def __init__(
        self,
        planner: str = "RRTConnect",
        time_limit: float | None = None,
        max_checks: int | None = 100_000,
        goals: int = 60,
        name: str | None = None,
        settings: Mapping[str, float] | None = None,
        unknown: str | float | None = None,
        margin: float | None = None,
        attempts: int = ATTEMPTS,
        unexplained: bool = False,
        fallback: bool = True,
        leaves: str | None = None,
    ):
        self.planner, self.unknown, self.margin = PLANNERS[planner].name, unknown, margin
        self.settings = PLANNERS[planner].with_settings({} if settings is None else settings)
        self.unexplained, self.fallback = check_flag("unexplained", unexplained), check_flag("fallback", fallback)
        self.leaves = leaves if leaves is None else require_choice("leaves", leaves, LEAVES)
        self.time_limit, self.max_checks, self.goals = time_limit, max_checks, goals
        self.name, self.attempts = name or planner, check_whole("attempts", attempts, 1)
        self.result: PlanResult | None = None
        self.level: Level = (0.0, "free")
        self._fell_back = False
        self._follower: PathFollower | None = None

    @property
    def status(self) -> str:
        """`greenhouse_gym.planning.PlanResult.status` of the last episode's plan, with its level if it fell back."""
        if self.result is None:
            return ""
        margin, unknown = self.level
        return f"{self.result.status}, margin {margin:g}, unknown {unknown}" if self._fell_back else self.result.status

    def reset(self, problem: Problem) -> None:
        """Plan a path."""
        self._follower = None
        levels = self._levels(problem.scene)
        tries = [(level, 0) for level in levels[:-1]] + [(levels[-1], k) for k in range(self.attempts)]
        for level, attempt in tries:
            result = self._plan(problem, level, problem.seed + attempt)
            leaves = "brush" if result.brushed_leaves else "rigid"
            follower = None if result.path is None else PathFollower(result.path, problem, proven=True, leaves=leaves)
            if self._follower is None or (follower and len(follower.commands) < len(self._follower.commands)):
                self.result, self.level, self._follower = result, level, follower
            if follower and len(follower.commands) <= problem.step_limit:
                break
        self._fell_back = self._follower is not None and self.level != levels[0]
        self._follower = self._follower or PathFollower(problem.start[None], problem)

    def _levels(self, scene: Scene) -> list[Level]:
        """Return margins and rules for unknown space to try in turn."""
        levels = [
            (margin if self.margin is None else self.margin, unknown if self.unknown is None else self.unknown)
            for margin, unknown in fallback_levels(scene)
        ]
        return list(dict.fromkeys(levels if self.fallback else levels[:1]))

    def _plan(self, problem: Problem, level: Level, seed: int) -> PlanResult:
        margin, unknown = level
        leaves = self.leaves or ("rigid" if problem.plants == "rigid" else "brush")
        return plan(
            problem.scene, problem.target, problem.robot, self.planner, self.time_limit, self.max_checks, self.goals,
            seed=seed, start=problem.start, settings=self.settings, unknown=unknown, margin=margin,
            unexplained=self.unexplained and problem.scene.occupancy is not None, leaves=leaves,
        )  # fmt: skip

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """Return the next action along the path; the observation is not used."""
        if self._follower is None:
            raise RuntimeError("reset the agent before it acts")
        return self._follower.action()
