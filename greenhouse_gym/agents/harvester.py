"""An oracle that harvests: it knows the true plants as they hang, and replans after each fruit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import NamedAgent, Problem
from greenhouse_gym.agents.planner_agent import safe_commands
from greenhouse_gym.envs.compliant_physics import CompliantSimulation
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import CollisionChecker
from greenhouse_gym.motion.inverse_kinematics import Approach, inverse_kinematics
from greenhouse_gym.motion.path import path_length
from greenhouse_gym.motion.proof import checker_of
from greenhouse_gym.planning import plan
from greenhouse_gym.plants.live import HANGING
from greenhouse_gym.plants.live_scene import LiveScene, live_scene
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import tool_chain
from greenhouse_gym.robots.robot import TIP_SITE
from greenhouse_gym.scene import Scene, compile_scene

Action = npt.NDArray[np.float32]

CANDIDATES = 3
"""Number of the nearest fruit to which paths are planned; the shortest one is taken."""

TRIES = 2
"""Number of attempts to pick a fruit."""

_ATTEMPTS = 4  # withdrawals with a fruit before it is given up
_CHECKS = 60_000  # collision checks of a plan
_GUESSES = 400  # configurations from which inverse kinematics starts above the crate
_CLOSING, _PULLING = 0.12, 0.12  # m/s
_TURNING = 1.6  # rad/s
_REACHES, _PULLS, _DROPS = 24, 40, 3  # actions at most to close the gap, to part the pedicel, to let go
_AROUND = 0.04  # metres: distance from the crate that paths to fruit keep where they can
_RETREAT, _BACK, _RETREATS = 0.05, 0.25, 16  # metres and m/s by which the tip withdraws, and actions at most
_DAMPING, _SHRUNK = 0.05, 0.9  # of the inverse kinematics; radius of a held fruit in plans over its own
_ABOVE, _SPREAD = 0.02, 0.07  # metres: height of the tip above the rim, and spread of the fruit in the crate


class OracleHarvester(NamedAgent):
    """Pick fruit after fruit with full knowledge of the true plants, as they hang at the moment.

    It plans to the nearest fruit, closes the gap, turns the fruit about its pedicel's joint while it pulls, withdraws
    along its path, plans to the crate and lets go. It is an upper bound for agents that have to see.

    Args:
        planner: A name in `greenhouse_gym.planning.PLANNERS`.
        name: Name in tables.
    """

    knows_truth = True
    env_options: Mapping[str, Any] = MappingProxyType({"task": "harvest", "plants": "compliant", "physics": "truth"})

    def __init__(self, planner: str = "RRTConnect", name: str = "harvest-oracle"):
        self.planner, self.name = planner, name
        self.status = ""
        self._script: Iterator[Action] = iter(())

    def reset(self, problem: Problem) -> None:
        """Begin an episode.

        Raises:
            InvalidValueError: The environment has no compliant plants.
        """
        if problem.live is None:
            raise InvalidValueError(f'agent {self.name!r} needs task="harvest" with plants="compliant"')
        self.status, self._script = "", _Harvest(self, problem, problem.live).run()

    def act(self, observation: Any) -> Action:
        """Return the next action."""
        return next(self._script)


class _Harvest:
    """One episode: a script of actions."""

    def __init__(self, agent: OracleHarvester, problem: Problem, live: CompliantSimulation):
        self._agent, self._problem, self._live, self._robot = agent, problem, live, problem.robot
        self._vacuum, self._seed, self._picked = -1.0, problem.seed, 0
        self._chain = tool_chain(live.world.compiled.model, live.world.compiled.tip_site)
        self._tried: dict[int, int] = {}
        self._guard = self._fixtures()
        self._scene: LiveScene
        self._failure = ""

    def run(self) -> Iterator[Action]:
        """Yield the actions of the episode."""
        while True:
            found = self._next()
            if found is None:
                yield self._action(np.zeros(len(self._robot.joints)))
                continue
            fruit, path = found
            self._tried[fruit] = self._tried.get(fruit, 0) + 1
            yield from self._follow(self._scene.scene, self._scene.tomatoes[fruit], path)
            yield from self._catch(fruit)
            yield from self._part(fruit)
            off = self._plants.held == fruit and self._plants.state[fruit] != HANGING
            if not off:
                self._vacuum = -1.0
            yield from self._withdraw()
            if off:
                yield from self._deliver()
                self._picked += 1

    def _fixtures(self) -> CollisionChecker:
        """Return the checker for motions among the plants, which must not touch fixtures, main stems and the crate."""
        scene = live_scene(self._live.plants, self._live.world.compiled, leaves=False, around_crate=_AROUND / 2).scene
        rigid = tuple(stem for stem in scene.stems if stem.kind not in ("peduncle", "pedicel"))
        scene = scene.model_copy(update={"tomatoes": scene.tomatoes[:1], "stems": rigid})
        return checker_of(compile_scene(scene, self._robot), 0)

    @property
    def _plants(self) -> Any:
        return self._live.plants

    @property
    def _command(self) -> Array:
        return np.asarray(self._live.data.act.copy())

    @property
    def _tip(self) -> tuple[Array, Array]:
        site = self._live.data.site_xpos[self._live.world.compiled.tip_site]
        frame = self._live.data.site_xmat[self._live.world.compiled.tip_site].reshape(3, 3)
        return site.copy(), frame[:, 2].copy()

    def _action(self, change: Array) -> Action:
        return np.append(np.clip(change / self._problem.joint_steps, -1, 1), self._vacuum).astype(np.float32)

    def _next(self) -> tuple[int, Array] | None:
        """Return a fruit to pick next and a path to it; None without one."""
        plants = self._plants
        left = [
            k
            for k in np.flatnonzero(plants.wanted & (plants.state == HANGING)).tolist()
            if self._tried.get(k, 0) < TRIES
        ]
        tip, _ = self._tip

        def rank(fruit: int) -> tuple[int, float]:
            return self._tried.get(fruit, 0), float(np.linalg.norm(plants.center(fruit) - tip))

        order = sorted(map(int, left), key=rank)
        for leaves, around in ((True, _AROUND), (True, 0.0), (False, 0.0)):
            scene = live_scene(plants, self._live.world.compiled, leaves, around)
            best: tuple[float, int, Array] | None = None
            for count, fruit in enumerate(order, start=1):
                path = self._plan(scene, scene.tomatoes[fruit], None)
                if path is not None and (best is None or path_length(path) < best[0]):
                    best = path_length(path), fruit, path
                if best is not None and count >= CANDIDATES:
                    break
            if best is not None:
                self._scene = scene
                return best[1:]
        if order:
            self._agent.status = f"no plan: {self._failure}"
        self._tried.update(dict.fromkeys(order, TRIES))
        return None

    def _plan(self, scene: LiveScene, target: int, goals: Array | None, robot: Robot | None = None) -> Array | None:
        start = np.clip(self._command, self._robot.lower, self._robot.upper)
        result = plan(
            scene.scene, target, robot or self._robot, self._agent.planner, time_limit=None, max_checks=_CHECKS,
            goals=30 if goals is None else goals, seed=self._seed, start=start,
        )  # fmt: skip
        self._failure = f"{result.status} {result.message}".strip()
        return result.path

    def _follow(self, scene: Scene, target: int, path: Array) -> Iterator[Action]:
        for command in safe_commands(scene, target, path, self._problem):
            yield self._action(command - self._command)

    def _catch(self, fruit: int) -> Iterator[Action]:
        """Close the gap to a fruit until the cup holds one."""
        self._vacuum = 1.0
        for _ in range(_REACHES):
            if self._plants.held >= 0:
                return
            tip, axis = self._tip
            offset = self._plants.center(fruit) - tip
            gap = float(np.linalg.norm(offset)) - self._plants.radius(fruit)
            speed = np.clip(gap / self._problem.interval, 0.01, _CLOSING)
            turn = np.cross(axis, offset / np.linalg.norm(offset))
            yield self._twist(offset / np.linalg.norm(offset) * speed, 2 * turn)

    def _part(self, fruit: int) -> Iterator[Action]:
        """Turn the held fruit about the joint of its pedicel and pull until it comes off."""
        plants, data = self._plants, self._live.data
        body = int(plants.planted.ids.fruit.ravel()[fruit])
        _, axis = self._tip
        to_fruit = plants.center(fruit) - data.xpos[body]
        side = self._free_side(fruit, np.cross(axis, to_fruit))
        for step in range(_PULLS):
            if plants.held != fruit or plants.state[fruit] != HANGING:
                return
            tip, now = self._tip
            spin = axis * side * _TURNING if step < 16 else np.zeros(3)
            yield self._twist(np.cross(spin, tip - data.xpos[body]) - now * _PULLING, spin)

    def _free_side(self, fruit: int, sideways: Array) -> float:
        """Return the sense of turning that moves the fruit away from its neighbors."""
        plants = self._plants
        others = [k for k in np.flatnonzero(plants.state == HANGING).tolist() if k != fruit]
        offsets = [plants.center(k) - plants.center(fruit) for k in others]
        near = [offset / max(offset @ offset, 1e-4) for offset in offsets if np.linalg.norm(offset) < 0.12]
        return -1.0 if float(np.sum(near, axis=0) @ sideways if near else 0.0) > 0 else 1.0

    def _withdraw(self) -> Iterator[Action]:
        """Pull the tool straight back until the tip, and the fruit at it, is clear of the truss."""
        start, axis = self._tip
        clear = _RETREAT + 2 * self._plants.radius(max(self._plants.held, 0))
        for _ in range(_RETREATS):
            tip, _ = self._tip
            if (start - tip) @ axis > clear:
                return
            yield self._twist(-axis * _BACK, np.zeros(3))

    def _deliver(self) -> Iterator[Action]:
        """Carry the held fruit to the crate and let go."""
        found = None
        for _ in range(_ATTEMPTS):
            found = self._path_to_crate()
            if found is not None or self._plants.held < 0:
                break
            yield from self._withdraw()  # the fruit is still too close to others
        if found is not None:
            yield from self._follow(found[0], 0, found[1])
        elif self._plants.held >= 0:
            self._agent.status = f"no path to the crate: {self._failure}"
        self._vacuum = -1.0
        for _ in range(_DROPS):
            yield self._action(np.zeros(len(self._robot.joints)))

    def _path_to_crate(self) -> tuple[Scene, Array] | None:
        """Return a path to the crate, with the held fruit clear of everything where one exists, and its scene."""
        goals = self._above_crate()
        loaded = with_fruit(self._robot, self._plants.radius(max(self._plants.held, 0)))
        for leaves, robot in ((True, loaded), (False, loaded), (False, self._robot)):
            scene = live_scene(self._plants, self._live.world.compiled, leaves)
            path = self._plan(scene, 0, goals, robot) if len(goals) else None
            if path is not None:
                return scene.scene, path
        return None

    def _above_crate(self) -> Array:
        """Return configurations with the tool pointing down into the crate."""
        ids, data, plants = self._plants.planted.ids, self._live.data, self._plants
        around = 2.4 * self._picked
        x, y = _SPREAD * np.cos(around), _SPREAD * np.sin(around)
        local = np.array([x, y, 2 * plants.crate.half_extents[2] + _ABOVE])
        point = data.xpos[ids.crate] + data.xmat[ids.crate].reshape(3, 3) @ local
        rng = np.random.default_rng(self._seed)
        guesses = np.concatenate(
            [self._command[None], rng.uniform(self._robot.lower, self._robot.upper, (_GUESSES, len(self._command)))]
        )
        down = Approach(np.array([0.0, 0.0, -1.0]), 0.35)
        found, _ = inverse_kinematics(self._chain, guesses, point, 0.0, self._robot, down)
        near = np.argsort(np.abs(found - self._command).max(axis=1), kind="stable")
        self._robot.keep_tool_roll(found, self._command)
        return np.clip(found[near[:20]], self._robot.lower, self._robot.upper)

    def _twist(self, velocity: Array, spin: Array) -> Action:
        """Return the action that moves the tip at a velocity, m/s, and turns it, rad/s, in the scene."""
        data, joints = self._live.data, len(self._robot.joints)
        tip, _ = self._tip
        axes, anchors, sliding = data.xaxis[:joints], data.xanchor[:joints], self._robot.sliding[:, None]
        linear = np.where(sliding, axes, np.cross(axes, tip - anchors))
        jacobian = np.concatenate([linear, np.where(sliding, 0.0, axes)], axis=1).T
        wanted = np.concatenate([velocity, spin]) * self._problem.interval
        square = jacobian @ jacobian.T + _DAMPING**2 * np.eye(6)
        change = jacobian.T @ np.linalg.solve(square, wanted)
        change /= max(1.0, float((np.abs(change) / self._problem.joint_steps).max()))
        command = self._command
        blocked = self._guard.is_free(command) and not self._guard.is_free(command + change)
        return self._action(change * 0.0 if blocked else change)


def with_fruit(robot: Robot, radius: float) -> Robot:
    """Return an arm with a fruit at its cup, for planning."""
    spec = robot.spec()
    tip = spec.site(TIP_SITE)
    middle = np.empty(3)
    mujoco.mju_rotVecQuat(middle, np.array([0.0, 0.0, radius]), np.array(tip.quat))
    tip.parent.add_geom(
        name="held_fruit", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[_SHRUNK * radius, 0, 0], pos=tip.pos + middle,
        mass=0, contype=1, conaffinity=3,
    )  # fmt: skip
    return replace(robot, specification=spec)
