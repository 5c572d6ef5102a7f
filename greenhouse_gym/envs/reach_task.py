"""The task in arrays of n simulations: its figures, and what the simulations look like at one moment.

Everything is elementwise, so a simulation's numbers do not depend on how many are computed at once. Points and
directions are in the frame of the arm's base: x forward to the plants, z up, origin at the base.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.mjcf import TIMESTEP

Float32: TypeAlias = npt.NDArray[np.float32]
Bools: TypeAlias = npt.NDArray[np.bool_]
Bytes: TypeAlias = npt.NDArray[np.uint8]

SUCCESS_RADIUS = 0.02
"""The grasp point this near to the target's center is a success, metres, unless the settings say otherwise."""

STEP_LIMIT = 200
"""Steps after which an episode is truncated, unless the settings say otherwise."""

RATE = 20
"""Actions per second, unless the settings say otherwise."""

SUBSTEPS = 5
"""Physics steps of 10 ms per action at the usual rate."""

ACTION_STEP = 0.08
"""What an action of 1 adds to a joint's command at the usual rate, radians."""

MAX_LEAD = 0.2
"""How far a command may lie from the measured joint at the usual rate, radians; at full speed the arm follows 0.1 rad
behind its commands."""


class Pace(NamedTuple):
    """How the time goes.

    Attributes:
        substeps: Physics steps per action.
        interval: Seconds from one action to the next.
        action_step: What an action of 1 adds to a joint's command, radians.
    """

    substeps: int = SUBSTEPS
    interval: float = SUBSTEPS * TIMESTEP
    action_step: float = ACTION_STEP


USUAL_PACE = Pace()


def pace_of(rate: float) -> Pace:
    """The pace at a number of actions per second; a joint's command moves at most as fast as at any other rate."""
    substeps = round(1 / (rate * TIMESTEP))
    return Pace(substeps, substeps * TIMESTEP, ACTION_STEP * (substeps / SUBSTEPS))


class Situation(NamedTuple):
    """What n simulations look like at one moment.

    Attributes:
        joints: (n, j) joint positions as the encoders tell them, radians.
        velocities: (n, j) joint velocities, rad/s.
        lead: (n, j) last commanded minus measured positions, radians.
        tip: (n, 3) middle of the cup, metres.
        axis: (n, 3) unit vector along the tool.
        grasp: (n, 3) grasp point, metres.
        target: (n, 3) center of the target as the agent knows it, metres.
        distance: (n,) from the grasp point to the center of what has to be reached, metres.
        clearance: (n, k) from the arm's surface at its probe points to the nearest obstacle, metres.
        obstacle: (n, k, 3) unit vectors from the probe points towards that obstacle, zero where it is far.
        room: (n, `ROOM`) distance to obstacles on rays away from the target, near and far, see `room_around`, metres;
            (n, 0) unless the observation asks for it.
        waypoint: (n, j) from the joint positions that are commanded to those where the arm can go straight, see
            `greenhouse_gym.envs.waypoints`, radians; (n, 0) unless the observation asks for it.
        way: (n, 2) the way from there to the goal, radians, and 1 where the straight motion is known to be free, else
            0; (n, 0) unless the observation asks for it.
        touched: (n,) whether anything was touched in any substep since the last situation.
        success: (n,) whether the grasp point is at the target and nothing was touched.
        seen: (n, k) whether the scan saw the places of the probe points; k is 0 unless the observation asks for it.
        depth: (n, c, h, w) depth along the view, metres, of c cameras; 0 where there is no reading; c is 0 without any.
        color: (n, c, h, w, 3) what the cameras see, 0 to 255; c is 0 unless the observation asks for it.
        views: (n, c, 4, 4) poses of the cameras, base_from_camera.
    """

    joints: Array
    velocities: Array
    lead: Array
    tip: Array
    axis: Array
    grasp: Array
    target: Array
    distance: Array
    clearance: Float32
    obstacle: Float32
    room: Float32
    waypoint: Array
    way: Array
    touched: Bools
    success: Bools
    seen: Bools
    depth: Float32
    color: Bytes
    views: Array

    def select(self, ids: npt.NDArray[np.int64]) -> Situation:
        """The situation of some of the simulations."""
        return Situation._make(values[ids] for values in self)

    def replaced(self, ids: npt.NDArray[np.int64], fresh: Situation) -> Situation:
        """A copy with the ``fresh`` situation of some of the simulations."""
        result = Situation._make(old.copy() for old in self)
        for name in self._fields:
            getattr(result, name)[ids] = getattr(fresh, name)
        return result


def lengths(vectors: Array) -> Array:
    """(n,) lengths of vectors (n, 3)."""
    squares = vectors * vectors
    return np.asarray(np.sqrt(squares[:, 0] + squares[:, 1] + squares[:, 2]))
