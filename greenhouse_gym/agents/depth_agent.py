"""An agent that knows of the plants only what the depth camera at its wrist has shown it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.guide import towards
from greenhouse_gym.agents.judging import DEEP, RESOLUTION, Judge, between, features_of, guessed, length
from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.agents.policy_agent import PolicyAgent
from greenhouse_gym.agents.sight_map import SightMap, sensed
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.approaches import FRONT, approaches, glance, looks_at
from greenhouse_gym.motion.arm_spheres import arm_balls
from greenhouse_gym.rendering.cameras import DepthCamera

EVERY = 5
"""Steps after which the agent looks for a way anew; it is also when it has come to the end of one."""

SURE = 0.9
"""Chance of a free way from which on the agent does not look from elsewhere first."""

HOPELESS = 0.1
"""Chance below which it stays where it is."""

LOOKS = 4
"""How many times the agent looks for a better view at most."""

CARE = 3.0
"""How many radians of way the agent makes rather than have its chance of a free one divided by e."""

_BLOCKED = -0.003  # metres: goals nearer to what was seen are none
_TRIED, _TRIED_OVER = 40, 120  # ways that are looked at, those that promise most first: straight, and over places
_AT_ONCE = 10  # ways that are looked at together
_LEG = np.linspace(0.1, 0.9, 6)[:, None]  # where motions to goals are looked at
_ROOM, _WORTH = 0.02, 15.0  # metres of room at the goal that count, and radians of way that a metre of it is worth
_NEW, _SAFE = 0.08, 0.75  # metres between places that it looks at, and chance of a free way to where it can see them
_ARRIVED = 1e-3  # radians
_KEPT = 0.3  # radians by which another way must be better than the one the arm is on


class Ways(NamedTuple):
    """Ways that were looked at together.

    Attributes:
        start: (j,) where they begin, radians.
        points: For each the (k, j) configurations that it leads to on straight motions, radians.
        features: (n, f) what is told about them, see `greenhouse_gym.agents.judging.FEATURES`.
        chances: (n,) of being free.
    """

    start: Array
    points: Sequence[Array]
    features: npt.NDArray[np.float32]
    chances: Array


class DepthAgent:
    """Looks at the target with the camera at its wrist, keeps what it has seen, and takes a way that is likely free.

    The images become points in the frame of its base. Its ways are straight motions to configurations that reach the
    target, also over places near those or over others. How likely a way is free a judge says, from how near it comes to
    what was seen and how much of it leads through space not seen. Of the ways, the agent takes the one that is short
    and likely free; while it is not sure, it looks where the best of them is dark.

    It is told the target's place and radius; of the scene it asks nothing else.

    Args:
        judge: Gives the chances (n,) of ways with features (n, f); a rule in which nothing is learned when left out,
            or a `Judge` with a network of `greenhouse_gym.learning.train_depth`.
        hear: Gets all ways that are looked at.
        name: How it is called in tables.
        images: Whether it looks, and takes in its images; without them it is blind.
    """

    name = "depth"
    env_options: Mapping[str, Any] = MappingProxyType({"observation": "depth"})

    def __init__(
        self,
        judge: Callable[[npt.NDArray[np.float32]], Array] = guessed,
        hear: Callable[[Ways], None] | None = None,
        name: str = "depth",
        images: bool = True,
    ):
        self.name = name
        self._judge, self._hear, self._images = judge, hear, images
        self._problem: Problem | None = None
        self._episode: _Episode | None = None

    @classmethod
    def of(cls, network: Policy, name: str) -> DepthAgent:
        """The agent that goes by a network of `greenhouse_gym.learning.train_depth`."""
        settings = network.training.get("settings", {})
        return cls(Judge(network), name=name, images=settings.get("images", True))

    def reset(self, problem: Problem) -> None:
        """Forget what was seen.

        Raises:
            InvalidValueError: The network was trained for another arm.
        """
        if isinstance(self._judge, Judge):
            PolicyAgent(self._judge.network, self.name).reset(problem)
        self._problem, self._episode = problem, None

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """The next action, (joints,)."""
        if self._problem is None:
            raise RuntimeError("reset the agent before it acts")
        now = sensed(observation, self._problem.robot)
        if self._episode is None:
            self._episode = _Episode(self._problem, self._judge, self._hear, now.target, self._images)
        return self._episode.act(now.depth, now.joints, now.command)


class _Choice(NamedTuple):
    """A way (k, j) with its chance of being free, and what it costs, radians."""

    points: Array
    chance: float
    cost: float


class _Entries(NamedTuple):
    """Places (n, j) from which the arm may go straight to goals (n, j), as the map of a version has it.

    The costs (n,) are the lengths of these motions, less where there is room at the goal, radians.
    """

    version: int
    places: Array
    goals: Array
    costs: Array


class _Episode:
    """What the agent knows and does in one episode; it begins with the first observation."""

    def __init__(
        self,
        problem: Problem,
        judge: Callable[[npt.NDArray[np.float32]], Array],
        hear: Callable[[Ways], None] | None,
        target: Array,
        images: bool,
    ):
        robot, radius = problem.robot, problem.scene.tomatoes[problem.target].radius
        self._arm, self._steps, self._judge, self._hear = arm_balls(robot), problem.joint_steps, judge, hear
        self._target, self._images = target, images
        self._map = SightMap(self._arm, DepthCamera(), target, radius)
        self._robot, self._start = robot, problem.start
        self._places = approaches(self._arm, robot, problem.start, target, radius)
        self._been: list[Array] = [problem.start]
        self._seen: list[Array] = []
        self._way: list[Array] = [glance(self._arm, robot, problem.start, FRONT * target)] if images else []
        self._looking, self._age = images, 0
        self._known: _Entries | None = None
        self._stuck = -1

    def act(self, depth: npt.NDArray[np.float32], joints: Array, command: Array) -> npt.NDArray[np.float32]:
        """The next action, (joints,)."""
        if self._images and self._age % 2 == 0 and self._stuck < 0:
            self._map.add(depth, joints)
        while self._way and np.abs(self._way[0] - command).max() < _ARRIVED:
            reached = self._way.pop(0)
            if self._looking:
                self._been.append(reached)
            self._looking = False
        if not self._looking and (not self._way or self._age % EVERY == 0) and self._stuck != self._map.version:
            self._decide(command)
        self._age += 1
        if not self._way:
            return np.zeros(len(command), dtype=np.float32)
        return towards(self._way[0], command, self._steps).astype(np.float32)

    def _decide(self, command: Array) -> None:
        """Choose a way anew, or stay on the one that was chosen, or look from elsewhere first."""
        choices = [self._best(command, self._ways(command, command[None], _TRIED))]
        if self._way:
            kept = self._best(command, [np.array(self._way)])
            choices.append(kept._replace(cost=kept.cost - _KEPT))
        if max(choice.chance for choice in choices) < SURE:
            over = np.concatenate([self._been, self._places.postures])
            choices.append(self._best(command, self._ways(command, over[self._room(over) > _BLOCKED], _TRIED_OVER)))
        best = min(choices, key=lambda choice: choice.cost)
        if best.chance < SURE and self._images and self._look(command, best.points):
            return
        self._way = list(best.points) if best.chance >= HOPELESS else []
        self._stuck = -1 if self._way else self._map.version  # seen from here, nothing will change

    def _look(self, command: Array, way: Array) -> bool:
        """Go where the target can be seen, or what is not known of a way (k, j); False where that is not to be."""
        point = self._dark(command, way) if self._seen else self._target
        if point is None or len(self._seen) == LOOKS or any(np.linalg.norm(point - p) < _NEW for p in self._seen):
            return False
        self._seen.append(point)
        looks = looks_at(self._arm, self._robot, self._start, point)
        near = np.abs(looks - command).max(axis=1).argsort(kind="stable")[:_AT_ONCE]
        best = self._best(command, [look[None] for look in looks[near]])
        if best.chance < _SAFE:
            return False
        self._way, self._looking = list(best.points), True
        return True

    def _dark(self, command: Array, way: Array) -> Array | None:
        """(3,) the middle of what a way (k, j) leads through among the plants and was not seen, metres."""
        around = self._map.around(between(self._arm.checker.reaches, np.array([command, *way])))
        moving = around.unknown & (self._arm.part >= 0) & (around.centers[..., 0] > self._target[0] - DEEP)
        return np.asarray(around.centers[moving].mean(axis=0)) if moving.any() else None

    def _ways(self, command: Array, places: Array, most: int) -> list[Array]:
        """Ways to goals that lead straight from one of some places (p, j), those that promise most first."""
        entries = self._entries()
        lengths = np.sqrt(((places - command) ** 2).sum(axis=1))[:, None] + entries.costs
        lengths += np.sqrt(((entries.places - places[:, None]) ** 2).sum(axis=-1))
        found = []
        for k in lengths.argsort(axis=None, kind="stable")[:most].tolist():
            place, entry = places[k // len(entries.costs)], k % len(entries.costs)
            points = [place, entries.places[entry], entries.goals[entry]]
            new = [p for p, before in zip(points, [command, *points], strict=False) if (p != before).any()]
            found += [np.array(new)] if new else []
        return found

    def _entries(self) -> _Entries:
        """The places from which the arm may go to goals, as far as it has seen."""
        if self._known is None or self._known.version != self._map.version:
            goals, before = self._places.goals, self._places.before
            room = self._room(goals)
            there = self._places.possible & (room > _BLOCKED)[:, None]
            there[there] = self._room(before[there]) > _BLOCKED
            goal, place = np.nonzero(there)
            legs = before[goal, place][:, None] + _LEG * (goals[goal] - before[goal, place])[:, None]
            free = self._room(legs.reshape(-1, goals.shape[1])).reshape(legs.shape[:2]).min(axis=1) > _BLOCKED
            goal, place = goal[free], place[free]
            straight = np.flatnonzero(room > _BLOCKED)
            ends = np.concatenate([goals[straight], goals[goal]])
            places = np.concatenate([goals[straight], before[goal, place]])
            bonus = _WORTH * np.minimum(room, _ROOM)[np.concatenate([straight, goal])]
            costs = np.sqrt(((ends - places) ** 2).sum(axis=1)) - bonus
            self._known = _Entries(self._map.version, places, ends, costs)
        return self._known

    def _room(self, configurations: Array) -> Array:
        """(m,) how near the arm comes to what was seen in configurations (m, j), metres."""
        return np.asarray(self._map.around(configurations).clearance[:, self._arm.part >= 0].min(axis=1))

    def _best(self, command: Array, ways: list[Array]) -> _Choice:
        """The cheapest of some ways, looked at a few at a time, until no other can be cheaper."""
        best = _Choice(command[None], 0.0, np.inf)
        lengths = [length(command, way) for way in ways]
        for k in range(0, len(ways), _AT_ONCE):
            some = ways[k : k + _AT_ONCE]
            features = features_of(self._map, self._target, len(self._been), command, some)
            chances = np.clip(self._judge(features), 1e-3, 0.999)
            if self._hear is not None:
                self._hear(Ways(command, some, features, chances))
            costs = lengths[k : k + _AT_ONCE] - CARE * np.log(chances)
            for i in costs.argsort(kind="stable").tolist():
                if costs[i] >= best.cost:
                    break
                if self._arm.checker.path_is_free([command, *some[i]], RESOLUTION):
                    best = _Choice(some[i], float(chances[i]), float(costs[i]))
                    break
            if best.cost <= min(lengths[k + _AT_ONCE :], default=np.inf):
                break
        return best
