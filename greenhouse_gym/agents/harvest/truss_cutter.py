"""Scripted harvest of whole trusses with a cutter, by full knowledge of the true plants."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.harvest.picking import Twist, pointing, with_load
from greenhouse_gym.agents.harvest.rehearsal import Action, Rehearsal, RehearsingAgent
from greenhouse_gym.envs.tasks.harvest import TomatoHarvest
from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.plants.cutting import CutterPlants
from greenhouse_gym.scene.plants.states import HANGING

_BEFORE = 0.06  # metres in front of the peduncle at which a path ends
_CLOSING, _CLOSES = 0.06, 40  # m/s, and actions at most
_BACK, _BACKS = 0.08, 30  # m/s, and actions of withdrawing
_STILL_ACTIONS = 20  # actions until a truss hangs still
_SINKING, _SINKS = 0.08, 80  # m/s, and actions at most
_CLEAR = 0.015  # metres between the lowest fruit and the rim or the bottom of the crate
_OPENS, _FALLS = 4, 80  # actions to open, and at most until the truss lies still
_YAWS = tuple(np.deg2rad([0.0, 35.0, -35.0, 70.0, -70.0]))  # of the tool at a peduncle, from straight ahead
_SEEDS = 2
_SHRUNK = 0.8  # radius of held fruit in plans over their own
_UP = np.array([0.0, 0.0, 1.0])
_NO_SPIN = np.zeros(3)


class TrussCutter(RehearsingAgent):
    """Cut the trusses one after the other and lay them into the crate; an oracle, like `OracleHarvester`.

    It plans to the front of a peduncle, closes in until the tool cuts and holds it, withdraws, plans to the crate with
    the fruit as parts of the arm, sinks into it and opens. Each of these is tried in copies of the simulation first.

    Args:
        planner: A name in `greenhouse_gym.planning.PLANNERS`.
        name: Name in tables.
    """

    needs = 'task=TomatoHarvest("truss", tool="cutter")'
    env_options: Mapping[str, Any] = MappingProxyType(
        {**RehearsingAgent.env_options, "task": TomatoHarvest("truss", tool="cutter")}
    )

    def __init__(self, planner: str = "RRTConnect", name: str = "truss-cutter"):
        super().__init__(planner, name)

    def _suits(self, rehearsal: Rehearsal) -> bool:
        return isinstance(rehearsal.plants, CutterPlants)

    def _actions(self, problem: Problem) -> Iterator[Action]:
        failed: set[int] = set()
        while True:
            start = Rehearsal(problem)
            truss = start.plants.work(start.tip[0]).number
            if truss < 0 or truss in failed:
                break
            actions = self._cut(problem, start, truss)
            if actions is None:
                failed.add(truss)
            yield from actions or ()

    def _cut(self, problem: Problem, start: Rehearsal, truss: int) -> list[Action] | None:
        """Return the actions that bring a truss into the crate with the least harm; None without any."""
        best: Rehearsal | None = None
        for heading in _YAWS:
            for seed in range(_SEEDS):
                trial = start.twin()
                self.status = self._try(problem, trial, truss, heading, seed)
                if not self.status and (best is None or trial.harm < best.harm):
                    best = trial
                if best is not None and best.harm == 0:
                    return best.actions
        return None if best is None else best.actions

    def _try(self, problem: Problem, trial: Rehearsal, truss: int, heading: float, seed: int) -> str:
        """Try to harvest a truss; return why it fails, or an empty text."""
        plants, robot, chain = trial.plants, problem.robot, trial.chain
        assert isinstance(plants, CutterPlants)
        point, base = plants.cut_point(truss), chain.offsets[0][:3, 3]
        ahead = (point - base) * [1.0, 1.0, 0.0]
        cosine, sine = np.cos(heading), np.sin(heading)
        ahead = np.array([cosine * ahead[0] - sine * ahead[1], sine * ahead[0] + cosine * ahead[1], 0.0])
        ahead /= np.linalg.norm(ahead)
        goals = pointing(ahead, chain, robot, trial.command, point - _BEFORE * ahead, problem.seed + seed)
        if not len(goals):
            return "no configuration at the peduncle"
        scene, _ = trial.scene(leaves=True)
        far = max(range(len(scene.tomatoes)), key=lambda k: float(np.linalg.norm(scene.tomatoes[k].center - point)))
        if failure := trial.follow(scene, far, self.planner, robot, goals, seed):
            return failure
        trial.move(_close(trial, truss))
        if plants.held_truss != truss:
            return "the tool does not reach the peduncle"
        trial.move(_withdraw(trial, -ahead))
        if trial.lost or not plants.holding:
            return "the truss is lost"
        return self._lay_down(problem, trial, truss, seed)

    def _lay_down(self, problem: Problem, trial: Rehearsal, truss: int, seed: int) -> str:
        """Bring the held truss into the crate and open the tool; return why it fails, or an empty text."""
        plants, robot = trial.plants, problem.robot
        assert isinstance(plants, CutterPlants)
        tip, _ = trial.tip
        fruit = plants.on_truss(truss)
        middles = np.array([plants.center(k) for k in fruit])
        radii = np.array([plants.radius(k) for k in fruit])
        below = float((tip[2] - middles[:, 2] + radii).max())
        spheres = (np.column_stack([(middles - tip) @ trial.frame, _SHRUNK * radii])).round(3)
        loaded = with_load(robot, tuple(map(tuple, spheres.tolist())))
        side = (middles.mean(axis=0) - tip) * [1.0, 1.0, 0.0]
        above = 2 * plants.crate.half_extents[2] + below + _CLEAR
        point = plants.above_crate(np.array([0.0, 0.0, above])) - side
        scene, tomatoes = trial.scene(leaves=True)
        others = list(tomatoes.values()) or range(len(scene.tomatoes))
        far = max(others, key=lambda k: float(np.linalg.norm(scene.tomatoes[k].center - tip)))
        for direction in ([1, 0, 0], [0, 1, 0], [-1, 0, 0], [1, 1, 0]):
            goals = pointing(np.array(direction, dtype=np.float64), trial.chain, loaded, trial.command, point, seed)
            if len(goals) and not (failure := trial.follow(scene, far, self.planner, loaded, goals, seed)):
                break
        else:
            return f"no path to the crate: {failure}" if len(goals) else "no configuration above the crate"
        trial.move(_sink(trial, truss))
        if trial.lost or not plants.holding or not plants.on_truss(truss):
            return "the truss is lost on the way to the crate"
        for _ in range(_OPENS):
            trial.step(np.zeros(len(robot.joints)), False)
        count = len(trial.actions)
        lying = trial.twin()
        for _ in range(_FALLS):
            lying.step(np.zeros(len(robot.joints)), False)
        trial.harm = lying.harm
        del trial.actions[count:]
        left = lying.plants.wanted & (lying.plants.state == HANGING)
        return "fruit would miss the crate" if lying.lost or left[fruit].any() else ""


def _close(hand: Rehearsal, truss: int) -> Iterator[Twist]:
    """Bring the tool to a peduncle until it holds the truss."""
    for _ in range(_CLOSES):
        plants = hand.plants
        assert isinstance(plants, CutterPlants)
        if plants.holding:
            return
        offset = plants.cut_point(truss) - hand.tip[0]
        distance = float(np.linalg.norm(offset))
        yield offset / distance * min(_CLOSING, distance / hand.interval), _NO_SPIN


def _withdraw(hand: Rehearsal, direction: Array) -> Iterator[Twist]:
    """Lift the truss a little and move it back, then wait until it hangs still."""
    for k in range(_BACKS):
        yield (direction + 0.5 * _UP) * min(_BACK, 0.02 * (k + 1)), _NO_SPIN
    for _ in range(_STILL_ACTIONS):
        yield np.zeros(3), _NO_SPIN


def _sink(hand: Rehearsal, truss: int) -> Iterator[Twist]:
    """Lower the truss until its lowest fruit is just above the bottom of the crate, or the tool is at the rim."""
    for _ in range(_SINKS):
        plants = hand.plants
        assert isinstance(plants, CutterPlants)
        fruit = plants.on_truss(truss)
        if not plants.holding or not fruit:  # lost on the way
            return
        lowest = min(float(plants.center(k)[2]) - plants.radius(k) for k in fruit)
        bottom = float(plants.above_crate(np.zeros(3))[2])
        room = min(lowest - bottom, hand.tip[0][2] - bottom - 2 * plants.crate.half_extents[2] - 0.04) - _CLEAR
        if room <= 0:
            return
        yield -_UP * min(_SINKING, room / hand.interval), _NO_SPIN
