"""Paths of an arm among what it knows of a scanned stand."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.harvest.scanned_stand import ScannedStand
from greenhouse_gym.agents.harvest.sensed_hand import SensedHand
from greenhouse_gym.agents.planner_agent import default_margin, default_unknown, safe_commands
from greenhouse_gym.geometry import Array
from greenhouse_gym.planning import plan
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene

_CHECKS = 40_000  # collision checks of a plan


class Level(NamedTuple):
    """Caution of a plan.

    Attributes:
        leaves: How leaves count, see `greenhouse_gym.planning.plan`.
        around: Metres by which the crate is thickened.
        apart: Metres by which fruit except the target, and stems, are thickened.
        cautious: Keep away from leaves, and out of space that the scan did not see.
        seen: Keep away from what the camera sees and the scan lacks.
    """

    leaves: str
    around: float
    apart: float
    cautious: bool
    seen: bool = True


class ScannedPaths:
    """Planner that starts at the current configuration, each time with another seed.

    Args:
        problem: The episode.
        hand: The hand.
        stand: The stand as it is known.
    """

    def __init__(self, problem: Problem, hand: SensedHand, stand: ScannedStand):
        self._problem, self._hand, self._stand = problem, hand, stand
        self._plans = 0

    def farthest(self, scene: Scene) -> int:
        """Return the tomato farthest from the tip, which a path that leads to none is given as its target."""
        tip, _ = self._hand.tip
        return int(np.argmax([np.linalg.norm(tomato.center - tip) for tomato in scene.tomatoes]))

    def commands(self, scene: Scene, target: int, arm: Robot, goals: int | Array, level: Level) -> list[Array] | None:
        """Return the commands along a planned path; None without one."""
        self._plans += 1
        start = np.clip(self._hand.command, arm.lower, arm.upper)
        scan = self._problem.scene
        unknown, margin = (default_unknown(scan), default_margin(scan)) if level.cautious else ("free", 0.0)
        result = plan(
            scene, target, arm, time_limit=None, max_checks=_CHECKS, goals=goals, start=start, unknown=unknown,
            seed=self._problem.seed + self._plans, margin=margin, leaves=level.leaves,
        )  # fmt: skip
        if result.path is None:
            return None
        kind = "brush" if level.leaves == "brush" and result.brushed_leaves else "rigid"
        commands = list(safe_commands(scene, target, result.path, replace(self._problem, robot=arm), kind))
        return commands if self._followed_freely(commands) else None

    def _followed_freely(self, commands: list[Array]) -> bool:
        """Return whether the arm, which lags behind commands, keeps away from itself and fixtures once it is away."""
        lag, joints, away = float(np.exp(-self._problem.interval / self._problem.robot.lag)), self._hand.joints, False
        for command in commands:
            joints = command + lag * (joints - command)
            free = self._stand.is_free(joints)
            if away and not free:
                return False
            away = away or free
        return True
