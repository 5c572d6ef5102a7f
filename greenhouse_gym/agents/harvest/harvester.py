"""Oracle of harvesting, which rehearses each pick in copies of the running simulation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.harvest.picking import (
    close_gap,
    part,
    pointing_down,
    retreats,
    spot,
    turns,
    with_fruit,
    withdraw,
)
from greenhouse_gym.agents.harvest.picking_order import PickingOrder
from greenhouse_gym.agents.harvest.rail import drive, parked_at, stops_of
from greenhouse_gym.agents.harvest.rehearsal import Action, Rehearsal, RehearsingAgent
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.plants.layout import ROW_REACH
from greenhouse_gym.scene.plants.live_scene import LiveScene
from greenhouse_gym.scene.plants.states import CRATED, HANGING

BUDGET = 1500
"""Number of actions that are rehearsed for a fruit at most."""

HARM = (0, 1)
"""Numbers of damaged organs and fruit knocked off that a pick may cost; the first one with a pick counts."""

_GOALS = 30  # configurations at a fruit
_AROUND = 0.04  # metres: distance from the crate that paths to fruit keep where they can
_SCENES = ((True, _AROUND), (True, 0.0), (False, 0.0))  # whether leaves are obstacles, and that distance
_SEEDS = 2  # plans in each of them
_ATTEMPTS = 3  # withdrawals with a fruit before a direction is given up
_DROPS, _FALLS = 3, 60  # actions to let go, and at most until the fruit lies still
_ABOVE = 0.02  # metres above the rim of the crate


class OracleHarvester(RehearsingAgent):
    """Pick one fruit after the other with full knowledge of the true plants and their current poses.

    It orders the fruit by a short tour, plans to the first one, closes the gap, turns the fruit about its pedicel's
    joint, withdraws, plans to the crate with the fruit as a part of the arm, and lets go. All this is tried in copies
    of the simulation first, with other paths, turns and withdrawals where it does harm. It is an upper bound for agents
    that have to see.

    Args:
        planner: A name in `greenhouse_gym.planning.PLANNERS`.
        name: Name in tables.
    """

    env_options: Mapping[str, Any] = MappingProxyType({**RehearsingAgent.env_options, "task": "harvest"})

    def __init__(self, planner: str = "RRTConnect", name: str = "harvest-oracle"):
        super().__init__(planner, name)

    def _actions(self, problem: Problem) -> Iterator[Action]:
        failures: dict[int, int] = {}
        picked = 0
        for stop in stops_of(problem.robot):
            if problem.robot.on_rail:
                yield from drive(problem, self.planner, stop)
            arm = parked_at(problem.robot, stop)
            order = PickingOrder(arm, self.planner, problem.seed)
            while True:
                pick = _Pick(problem, arm, self.planner, order, failures, picked)
                actions = pick.find()
                if actions is None:
                    break
                yield from actions
                picked += 1
            self.status = pick.failure


class _Pick:
    """Search for the actions that bring one fruit into the crate: depth first, through trials of its stages.

    Args:
        problem: The episode.
        arm: The arm, parked if it stands on a rail.
        planner: Name of the planner.
        order: Order of the fruit.
        failures: How often no harmless pick of a fruit was found so far, by fruit; updated.
        picked: Number of fruit in the crate.
    """

    def __init__(
        self, problem: Problem, arm: Robot, planner: str, order: PickingOrder, failures: dict[int, int], picked: int
    ):
        self._problem, self._planner, self._failures, self._picked = problem, planner, failures, picked
        self._robot, self._order = arm, order
        self._start = Rehearsal(problem)
        self._harm, self._budget = 0, 0
        self._scenes: dict[tuple[bool, float], LiveScene] = {}
        self.failure = ""

    def find(self) -> list[Action] | None:
        """Return the actions of the pick with the least harm; None without one."""
        plants = self._start.plants
        left = np.flatnonzero(plants.wanted & (plants.state == HANGING)).tolist()
        if self._robot.on_rail:
            left = [fruit for fruit in left if np.linalg.norm(plants.center(fruit) - self._start.shoulder) < ROW_REACH]
        tour = self._order.of(self._start, left, self._above_crate(self._start))
        for self._harm in HARM:
            for fruit in sorted(tour, key=lambda fruit: self._failures.get(fruit, 0)):
                self._budget = self._start.rehearsed + BUDGET
                for actions in self._picks(fruit):
                    return actions
                self._failures[fruit] = self._failures.get(fruit, 0) + 1
        return None

    def _picks(self, fruit: int) -> Iterator[list[Action]]:
        """Yield the actions of trials after which the fruit lies in the crate."""
        for caught in self._catches(fruit):
            for axis in turns(caught, fruit):
                off = caught.twin()
                off.move(part(off, fruit, axis))
                if not self._goes_on(off, fruit) or off.plants.state[fruit] == HANGING:
                    continue
                for direction in retreats(off):
                    trial = off.twin()
                    if not self._deliver(trial, fruit, direction):
                        continue
                    actions = list(trial.actions)
                    trial.wait(fruit, _FALLS)
                    if self._harmless(trial) and trial.plants.state[fruit] == CRATED:
                        yield actions
                    self.failure = f"fruit {fruit} would miss the crate"

    def _catches(self, fruit: int) -> Iterator[Rehearsal]:
        """Yield trials that hold the fruit."""
        for seed in range(_SEEDS):
            for leaves, around in _SCENES:
                if (leaves, around) not in self._scenes:
                    self._scenes[leaves, around] = self._start.scene(leaves, around)
                scene, tomatoes = self._scenes[leaves, around]
                trial = self._start.twin()
                if not self._follow(trial, scene, tomatoes[fruit], self._robot, _GOALS, seed):
                    continue
                trial.move(close_gap(trial, fruit))
                if self._goes_on(trial, fruit):
                    yield trial
                    break

    def _deliver(self, trial: Rehearsal, fruit: int, direction: Array) -> bool:
        """Withdraw, carry the fruit above the crate and let go; return whether a path exists and nothing is lost."""
        loaded = with_fruit(self._robot, trial.plants.radius(fruit))
        for _ in range(_ATTEMPTS):
            trial.move(withdraw(trial, direction))
            if not self._goes_on(trial, fruit):
                return False
            scene, tomatoes = trial.scene(leaves=True)
            others = tomatoes.values() or range(len(scene.tomatoes))  # with the last fruit, none to be picked hangs
            far = max(others, key=lambda k: float(np.linalg.norm(scene.tomatoes[k].center - trial.tip[0])))
            goals = pointing_down(trial.chain, self._robot, trial.command, self._above_crate(trial), self._problem.seed)
            if self._follow(trial, scene, far, loaded, goals, 0):
                break
        else:
            return False
        if not self._goes_on(trial, fruit):
            return False
        for _ in range(_DROPS):
            trial.step(np.zeros(len(self._robot.joints)), False)
        return True

    def _follow(self, trial: Rehearsal, scene: Scene, target: int, arm: Robot, goals: int | Array, seed: int) -> bool:
        """Plan and follow a path; return whether there is one."""
        failure = trial.follow(scene, target, self._planner, arm, goals, seed)
        self.failure = failure or self.failure
        return not failure

    def _harmless(self, trial: Rehearsal) -> bool:
        """Return whether a trial has lost nothing and done no more harm than allowed."""
        return not trial.lost and trial.harm <= self._harm and trial.rehearsed <= self._budget

    def _goes_on(self, trial: Rehearsal, fruit: int) -> bool:
        """Return whether a trial holds the fruit and does no harm."""
        if trial.plants.held != fruit:
            self.failure = f"fruit {fruit} would not be held"
            return False
        self.failure = f"picking fruit {fruit} would damage {trial.harm} organs or fruit"
        return self._harmless(trial)

    def _above_crate(self, trial: Rehearsal) -> Array:
        """Return where (3,) above the crate to let go of the next fruit."""
        plants = trial.plants
        return plants.above_crate(np.append(spot(self._picked), 2 * plants.crate.half_extents[2] + _ABOVE))
