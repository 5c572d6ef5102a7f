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

MAX_COMMAND_ERROR = 0.2
"""How far a command may lie from the measured joint at the usual rate, radians; at full speed the arm follows 0.1 rad
behind its commands."""


class ControlTiming(NamedTuple):
    """How the time goes.

    Attributes:
        substeps: Physics steps per action.
        interval: Seconds from one action to the next.
        action_step: What an action of 1 adds to a joint's command, radians.
    """

    substeps: int = SUBSTEPS
    interval: float = SUBSTEPS * TIMESTEP
    action_step: float = ACTION_STEP


DEFAULT_TIMING = ControlTiming()


def control_timing(rate: float) -> ControlTiming:
    """The timing at a number of actions per second; a joint's command moves at most as fast as at any other rate."""
    substeps = round(1 / (rate * TIMESTEP))
    return ControlTiming(substeps, substeps * TIMESTEP, ACTION_STEP * (substeps / SUBSTEPS))


class State(NamedTuple):
    """What n simulations look like at one moment.

    Attributes:
        joints: (n, j) joint positions as the encoders tell them, radians.
        velocities: (n, j) joint velocities, rad/s.
        command_error: (n, j) last commanded minus measured positions, radians.
        tip: (n, 3) middle of the cup, metres.
        axis: (n, 3) unit vector along the tool.
        grasp: (n, 3) grasp point, metres.
        target: (n, 3) center of the target as the agent knows it, metres.
        distance: (n,) from the grasp point to the center of what has to be reached, metres.
        clearance: (n, k) from the arm's surface at its probe points to the nearest obstacle, metres.
        obstacle: (n, k, 3) unit vectors from the probe points towards that obstacle, zero where it is far.
        clearance_rays: (n, `NUM_CLEARANCES`) clearances on rays from the target, metres; (n, 0) unless requested.
        waypoint: (n, j) from the joint positions that are commanded to those where the arm can go straight, see
            `greenhouse_gym.motion.waypoints`, radians; (n, 0) unless the observation asks for it.
        path_length: (n,) length of the path from the waypoint to the goal, radians; NaN unless requested.
        path_free: (n,) whether the straight motion to the waypoint is collision-free; False unless requested.
        collided: (n,) whether anything was touched in any substep since the last state.
        success: (n,) whether the grasp point is at the target and nothing was touched.
        unknown: (n, k) whether the probe points lie in space that the scan did not observe; k is 0 unless requested.
        depth: (n, c, h, w) depth along the view, metres, of c cameras; 0 where there is no reading; c is 0 without any.
        color: (n, c, h, w, 3) what the cameras see, 0 to 255; c is 0 unless the observation asks for it.
        views: (n, c, 4, 4) poses of the cameras, base_from_camera.
    """

    joints: Array
    velocities: Array
    command_error: Array
    tip: Array
    axis: Array
    grasp: Array
    target: Array
    distance: Array
    clearance: Float32
    obstacle: Float32
    clearance_rays: Float32
    waypoint: Array
    path_length: Array
    path_free: Bools
    collided: Bools
    success: Bools
    unknown: Bools
    depth: Float32
    color: Bytes
    views: Array

    def select(self, ids: npt.NDArray[np.int64]) -> State:
        """The state of some of the simulations."""
        return State._make(values[ids] for values in self)

    def replaced(self, ids: npt.NDArray[np.int64], fresh: State) -> State:
        """A copy with the ``fresh`` state of some of the simulations."""
        result = State._make(old.copy() for old in self)
        for name in self._fields:
            getattr(result, name)[ids] = getattr(fresh, name)
        return result


def lengths(vectors: Array) -> Array:
    """(n,) lengths of vectors (n, 3)."""
    squares = vectors * vectors
    return np.asarray(np.sqrt(squares[:, 0] + squares[:, 1] + squares[:, 2]))
