"""Goal configurations in the observation of a training on a device, chosen by the critic as an episode begins."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from greenhouse_gym.agents.goal_inputs import DIRECTION, goal_layout, goal_parts
from greenhouse_gym.common.executors import usable_cores
from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.progress import progress
from greenhouse_gym.envs.features import Layout, feature_slices
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.motion.goal_options import goal_options
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene, compile_scene

with needs("train"):
    import torch
    from torch import Tensor, nn

    from greenhouse_gym.learning.device_networks import Networks

EXPLORATION = 0.25
"""Fraction of episodes whose goal is drawn at random, so that the critic learns what the others are worth."""


class GoalChoices:
    """Goal configurations of all targets that may be drawn, and those chosen in n simulations.

    Args:
        env: The environment, with joint actions, the observation "state" and tensors on a CPU.
        count: Number of goals of a target among which the critic chooses.

    Attributes:
        layout: Layout of the observation followed by the features of the goal.
    """

    def __init__(self, env: Any, count: int):
        simulation = env.simulation
        arrays, observed = simulation.bank.arrays, simulation.observe.layout
        robot: Robot = simulation.robot
        self._at, self._count = feature_slices(observed), count
        self.layout: Layout = (*observed, *goal_layout(len(robot.joints), len(robot.probes)))
        row_of = {(int(s), int(k)): row for row, (s, k) in enumerate(zip(arrays.scene, arrays.tomato, strict=True))}
        goals = np.broadcast_to(robot.start, (len(row_of), count, len(robot.joints))).astype(np.float32)
        room = np.zeros((len(row_of), count, len(robot.probes)), dtype=np.float32)
        scenes: list[Scene] = simulation.bank.scenes

        def find(index: int) -> None:
            scene, compiled = scenes[index], compile_scene(scenes[index], robot)
            for target in simulation.sampler.fitting(scene, tuple(simulation.sampler.difficulty)):
                found = goal_options(compiled, target.tomato, robot.start)
                if len(found.configurations):
                    row, chosen = row_of[index, target.tomato], _spread(len(found.configurations), count)
                    goals[row], room[row] = found.configurations[chosen], found.clearance[chosen]

        with ThreadPoolExecutor(usable_cores()) as threads, progress("goals of scenes found", len(scenes)) as shown:
            for done, _ in enumerate(threads.map(find, range(len(scenes))), start=1):
                shown(done)
        self._goals, self._room = torch.from_numpy(goals), torch.from_numpy(room)
        self._row, self._steps = env.target_rows, env.episode_steps
        self._goal, self._clearance = self._goals[self._row, 0].clone(), self._room[self._row, 0].clone()

    def __call__(self, observation: Tensor, networks: Networks, begun: Tensor | None = None) -> Tensor:
        """Return observations (n, size) with the features of the chosen goals.

        Args:
            observation: (n, size) observations of the environment.
            networks: Networks whose critic chooses.
            begun: (n,) mask of the simulations whose episode has just begun; found by their steps if None.
        """
        fresh = torch.nonzero(self._steps == 0 if begun is None else begun).squeeze(1)
        if len(fresh):
            rows, count = self._row[fresh], self._count
            seen = observation[fresh].repeat_interleave(count, 0)
            inputs = self._inputs(seen, self._goals[rows].flatten(0, 1), self._room[rows].flatten(0, 1))
            best = networks(inputs)[1].reshape(-1, count).argmax(1)
            explores = torch.rand(len(fresh)) < EXPLORATION
            chosen = torch.where(explores, torch.randint(count, (len(fresh),)), best)
            self._goal[fresh], self._clearance[fresh] = self._goals[rows, chosen], self._room[rows, chosen]
        return self._inputs(observation, self._goal, self._clearance)

    def _inputs(self, seen: Tensor, goal: Tensor, clearance: Tensor) -> Tensor:
        return torch.cat(goal_parts(seen, self._at, goal, clearance, _largest), 1)


def begin_as_straight_line(networks: Networks, layout: Layout) -> None:
    """Let an untrained actor move straight to its goal: two units of each hidden layer pass each joint's direction on.

    Args:
        networks: The networks.
        layout: Layout of the observation, with the feature "goal_direction".

    Raises:
        InvalidValueError: A hidden layer has fewer than two units for each joint.
    """
    at = feature_slices(layout)[DIRECTION]
    layers = [layer for layer in networks.actor if isinstance(layer, nn.Linear)]
    joints, widths = at.stop - at.start, [layer.out_features for layer in layers[:-1]]
    if min(widths) < 2 * joints:
        raise InvalidValueError(f"with goals, hidden layers need {2 * joints} units or more, got {widths}")
    identity = torch.eye(joints)
    both = torch.cat([identity, -identity])
    with torch.no_grad():
        for layer in layers[:-1]:
            layer.weight[: 2 * joints] = 0.0
        layers[0].weight[: 2 * joints, at] = both * networks.scale[at]
        for layer in layers[1:-1]:
            layer.weight[: 2 * joints, : 2 * joints] = torch.eye(2 * joints)
        layers[-1].weight[:, : 2 * joints] = both.T


def _spread(found: int, count: int) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return ``count`` indices spread evenly over those found; with fewer, some repeat."""
    return np.linspace(0, found - 1, count).round().astype(np.int64)


def _largest(rows: Tensor) -> Tensor:
    return rows.abs().amax(1, keepdim=True)
