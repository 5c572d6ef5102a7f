"""An agent that plans once at an episode's start and follows its path."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.envs.actions import INTERVAL, joint_steps
from greenhouse_gym.envs.settings import check_whole
from greenhouse_gym.geometry import Array
from greenhouse_gym.planning import PLANNERS, PlanResult, follow_path, free_commands, plan
from greenhouse_gym.scene import Scene, compile_scene

CAREFUL = 0.15
"""How deep planned paths enter unknown space by default, metres: the leaves that paths hit hang deeper in it."""

SEEN_ENOUGH = ("upright-back",)
"""Protocols that see the leaves in the aisle: plans held there without care, and with it many tomatoes had none."""

RIM = 0.01
"""How far planned paths keep from boxes of leaves by default, metres; see `greenhouse_gym.motion.margins`."""


def usual_care(scene: Scene) -> str | float:
    """What space that the scan did not see is by default, as `greenhouse_gym.planning.plan` takes it."""
    return "free" if scene.occupancy is None or scene.provenance.protocol in SEEN_ENOUGH else CAREFUL


def usual_margin(scene: Scene) -> float:
    """How far paths keep from boxes of clutter by default, metres.

    Boxes that go by the area of the foliage are thin, and leaves reach beyond them. Those of scenes that were built
    before are thick already where leaves are dense, and nobody knows of boxes from elsewhere.
    """
    shapes = scene.provenance.settings.get("shapes")
    return RIM if isinstance(shapes, dict) and "clutter_per_area" in shapes else 0.0


class PathFollower:
    """Turns a joint path into the environment's actions, one after the other, and then stays still.

    Args:
        path: (k, joints) radians, from where the arm is.
        problem: The episode: its arm's limits on speed and acceleration hold, and its kind of action.
        proven: Whether the path is proven free, and the commands are to be so, too; see `free_commands`.

    Attributes:
        commands: (steps, joints) what is commanded after each action, radians.

    Raises:
        InvalidValueError: The environment's actions are no motions of the joints.
    """

    def __init__(self, path: Array, problem: Problem, proven: bool = False):
        robot, steps, interval = problem.robot, problem.joint_steps, problem.interval
        speed = np.minimum(np.minimum(robot.velocity_limits, steps / interval), joint_steps(robot) / INTERVAL)
        limits = (path, speed, robot.acceleration_limits, interval)
        if proven:
            self.commands = free_commands(compile_scene(problem.scene, robot), problem.target, *limits)
        else:
            self.commands = follow_path(*limits, lag=robot.lag)
        self._actions = iter(np.diff(self.commands, axis=0, prepend=path[:1]) / steps)
        self._still = np.zeros(len(steps))

    def action(self) -> npt.NDArray[np.float32]:
        """The next action, (joints,) in [-1, 1]."""
        return next(self._actions, self._still).astype(np.float32)


class PlannerAgent:
    """Plans with any planner and follows the path through the environment's actions; stays still without a path.

    It needs an environment whose actions move the joints: increments or velocities.

    Args:
        planner: A name in `greenhouse_gym.planning.PLANNERS`.
        time_limit: Seconds the planner may search, or None: what it finds then hangs on how busy the machine is.
        max_checks: Collision checks after which it stops, or None; the usual number takes some seconds.
        goals: Number of goal configurations.
        name: Shown in tables; the planner's name when left out.
        settings: Parameters of the planner to change, as `greenhouse_gym.planning.plan` takes them.
        unknown: What space that the scan did not see is, as `greenhouse_gym.planning.plan` takes it. When left out, it
            is entered no deeper than `CAREFUL`, but free where a scene does not say what was seen, and where its
            protocol is one of `SEEN_ENOUGH`.
        margin: How far it keeps from boxes of clutter, metres, as `greenhouse_gym.planning.plan` takes it. When left
            out, `RIM` in scenes whose boxes go by the area of the foliage, as they are built now, and 0 in others.
        attempts: How many times it plans at most while there is no path, each time with another seed.
        unexplained: Whether it keeps out of where the scan saw a surface without a shape, in scenes that say what was
            seen; see `greenhouse_gym.motion.unexplained_cells`.

    Attributes:
        result: The last episode's plan, or None before the first.

    Raises:
        UnknownNameError: No such planner, or no such parameter of it.
        InvalidValueError: The attempts are no whole number from 1 up.
    """

    env_options: Mapping[str, Any] = MappingProxyType({})

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
        attempts: int = 1,
        unexplained: bool = False,
    ):
        self.planner, self.unknown, self.margin = PLANNERS[planner].name, unknown, margin
        self.settings = PLANNERS[planner].with_settings(settings or {})
        self.unexplained = unexplained
        self.time_limit, self.max_checks, self.goals = time_limit, max_checks, goals
        self.name, self.attempts = name or planner, check_whole("attempts", attempts, 1)
        self.result: PlanResult | None = None
        self._follower: PathFollower | None = None

    @property
    def status(self) -> str:
        """What became of the last episode's plan, see `greenhouse_gym.planning.PlanResult.status`."""
        return "" if self.result is None else self.result.status

    def reset(self, problem: Problem) -> None:
        """Plan."""
        for attempt in range(self.attempts):
            self.result = plan(
                problem.scene, problem.target, problem.robot, self.planner, self.time_limit, self.max_checks,
                self.goals, seed=problem.seed + attempt, start=problem.start, settings=self.settings,
                unknown=usual_care(problem.scene) if self.unknown is None else self.unknown,
                margin=usual_margin(problem.scene) if self.margin is None else self.margin,
                unexplained=self.unexplained and problem.scene.occupancy is not None,
            )  # fmt: skip
            if self.result.path is not None:
                break
        assert self.result is not None
        if self.result.path is None:
            self._follower = PathFollower(problem.start[None], problem)
        else:
            self._follower = PathFollower(self.result.path, problem, proven=True)

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """The next action along the path, whatever is observed."""
        if self._follower is None:
            raise RuntimeError("reset the agent before it acts")
        return self._follower.action()
