"""Configurations from which the camera at the wrist sees given points: next-best-view search (Connolly, 1985)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.occupancy_map import wrist_camera
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.arm_spheres import ArmSpheres
from greenhouse_gym.motion.roadmap import RESOLUTION
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import tool_state

VIEWPOINTS, SPREADS = 400, (0.24, 1.2)
"""Sampled configurations, and the range of the standard deviations of their joints around the current one, radians."""

MIN_GAIN = 0.2
"""Fraction of the points that a viewpoint must show."""

DEPTHS, NOISY_DEPTHS = (0.1, 1.2), (0.2, 1.0)
"""Depths within which points are seen well, by a perfect camera and by one with the noise of a D435, metres."""

_BATCHES = 10  # into which the samples are split, to save memory
_MOTION_COST = 0.1  # fraction of the points that is worth a motion of a radian
_EDGE = 0.95  # fraction of the image that counts as its inside
_STEP, _SHORT = 0.04, 0.08  # metres between samples along a ray, and before its end, where it may be occluded
_WRIST_ANGLES = 25  # tried for each wrist joint in an initial view
_IN_VIEW = 0.4  # radians from the tool's axis

Seen = npt.NDArray[np.bool_]


def viewpoints(
    robot: Robot,
    command: Array,
    sees: Callable[[Array], npt.NDArray[Any]],
    rng: np.random.Generator,
    min_gain: float = MIN_GAIN,
) -> Iterator[tuple[Array, npt.NDArray[Any]]]:
    """Yield configurations (j,) from which the camera sees many points, and which points it sees, best first.

    Args:
        robot: The arm.
        command: (j,) current configuration, radians.
        sees: Returns which of k points, or how much of each, the camera sees in configurations (m, j): (m, k).
        rng: Samples the configurations.
        min_gain: Fraction of the points that a viewpoint must show.
    """
    spreads = np.linspace(*SPREADS, VIEWPOINTS)[:, None]
    samples = np.clip(command + spreads * rng.normal(size=(VIEWPOINTS, len(command))), robot.lower, robot.upper)
    robot.keep_tool_roll(samples, command)
    batches = np.split(samples, _BATCHES)
    seen = np.concatenate([sees(batch) for batch in batches])
    gains = seen.mean(axis=1)
    costs = np.where(gains < min_gain, np.inf, _MOTION_COST * np.abs(samples - command).max(axis=1) - gains)
    for k in costs.argsort(kind="stable")[: np.isfinite(costs).sum()]:
        yield samples[k], seen[k]


class OpaqueCells(NamedTuple):
    """Cells of a grid that hide what is behind them.

    Attributes:
        cells: (x, y, z) which cells are opaque.
        low: (3,) lower corner of the grid, metres.
        cell: Side of a cell, metres.
        pose: (4, 4) pose of the arm's base in the frame of the grid.
    """

    cells: npt.NDArray[np.bool_] = np.zeros((0, 0, 0), dtype=np.bool_)
    low: Array = np.zeros(3)
    cell: float = 1.0
    pose: Array = np.eye(4)


NOTHING_OPAQUE = OpaqueCells()
"""A grid without cells."""


def visible(
    arm: ArmSpheres,
    configurations: Array,
    points: Array,
    opaque: OpaqueCells = NOTHING_OPAQUE,
    depths: tuple[float, float] = DEPTHS,
) -> Seen:
    """Return which points (k, 3) the camera sees within a range of depths in configurations (m, j): (m, k)."""
    from greenhouse_gym.motion.visibility_kernels import mark_seen  # loads numba

    turns, origins = map(np.ascontiguousarray, wrist_camera(arm.chain, configurations))
    camera = DepthCamera()
    limits = np.array([*depths, *(_EDGE * size / 2 / camera.focal for size in (camera.width, camera.height))])
    seen = np.empty((len(configurations), len(points)), dtype=np.bool_)
    mark_seen(
        turns, origins, np.ascontiguousarray(points), opaque.cells.reshape(-1), opaque.pose,
        opaque.low, np.array(opaque.cells.shape), opaque.cell, limits, _STEP, _SHORT, seen,
    )  # fmt: skip
    return seen


def initial_view(arm: ArmSpheres, robot: Robot, start: Array, point: Array) -> Array:
    """Return a configuration (j,) with a point (3,) in view that differs from a start (j,) in the wrist joints only.

    The tool keeps away from the plants, which are not known yet. The start itself is returned if no motion to such a
    configuration is free of contacts with the arm itself, its stand and the floor.
    """
    last = len(start) - 1 - robot.rolls_tool
    wrist = [last - 1, last]  # the two joints that point the tool
    samples = np.tile(start, (_WRIST_ANGLES**2, 1))
    angles = (np.linspace(robot.lower[k], robot.upper[k], _WRIST_ANGLES) for k in wrist)
    samples[:, wrist] = np.stack(np.meshgrid(*angles), axis=-1).reshape(-1, 2)
    state = tool_state(arm.chain, samples)
    offset = point - state.point
    cosine = (offset * state.axis).sum(axis=1) / np.sqrt((offset**2).sum(axis=1))
    outside = np.maximum(np.arccos(np.clip(cosine, -1.0, 1.0)) - _IN_VIEW, 0.0)
    costs = outside + state.point[:, 0] + 0.1 * np.abs(samples - start).max(axis=1)
    for k in costs.argsort(kind="stable"):
        if arm.checker.motion_is_free(start, samples[k], RESOLUTION):
            return np.asarray(samples[k])
    return start
