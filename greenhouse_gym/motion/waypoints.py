"""Current waypoints of many simulations, on the roadmap of each one's episode."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.roadmap import REACHED, Roadmap

EVERY = 8
"""Steps after which waypoints are queried again; they are also queried on arrival."""


class WaypointTracker:
    """Current waypoints of n simulations, re-queried every `EVERY` steps and on arrival.

    Args:
        count: Number of simulations n.
        joints: Number of joints j.

    Attributes:
        configuration: (n, j) the waypoints, radians.
        cost_to_go: (n,) length of the path from there to the goal, radians.
        free: (n,) whether the straight motion to the waypoint is known to be free.
    """

    def __init__(self, count: int, joints: int):
        self.configuration, self.cost_to_go = np.zeros((count, joints)), np.zeros(count)
        self.free = np.zeros(count, dtype=np.bool_)
        self._roadmaps: list[Roadmap | None] = [None] * count

    def __deepcopy__(self, memo: dict[int, Any]) -> WaypointTracker:
        """Copy the state; roadmaps are never changed and are shared."""
        twin = memo[id(self)] = object.__new__(WaypointTracker)
        twin.configuration, twin.cost_to_go = self.configuration.copy(), self.cost_to_go.copy()
        twin.free, twin._roadmaps = self.free.copy(), self._roadmaps.copy()
        return twin

    def begin(self, i: int, roadmap: Roadmap) -> None:
        """Begin an episode of simulation ``i``."""
        self._roadmaps[i] = roadmap

    def update(self, ids: npt.NDArray[np.int64], command: Array, steps: npt.NDArray[np.int64]) -> None:
        """Query the waypoints that are due.

        Args:
            ids: Indices of k simulations.
            command: (k, j) their commanded joint positions, radians.
            steps: (k,) steps of their episodes so far.
        """
        arrived = (np.abs(self.configuration[ids] - command).max(axis=1) < REACHED) & (self.cost_to_go[ids] > 0)
        for k in np.flatnonzero(arrived | (steps % EVERY == 0)):
            i, roadmap = ids[k], self._roadmaps[ids[k]]
            assert roadmap is not None
            waypoint = roadmap.waypoint(command[k])
            # halfway along a free motion an obstacle may be nearer than the margin, which holds at the checks only
            if waypoint.free or arrived[k] or not self.free[i] or steps[k] == 0:
                self.configuration[i], self.cost_to_go[i], self.free[i] = waypoint
