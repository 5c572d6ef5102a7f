"""Agents that find fruit by a sequence of views: planned, fixed or random ones."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import islice
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation, distance_transform_edt

from greenhouse_gym.agents.agent import JointAgent, Problem, action_towards
from greenhouse_gym.agents.occupancy_map import wrist_camera
from greenhouse_gym.agents.viewpoints import DEPTHS, viewpoints
from greenhouse_gym.envs.features import feature_slices
from greenhouse_gym.envs.observations import TaskObservation
from greenhouse_gym.envs.tasks.look import MAP, RIPE, TomatoLook
from greenhouse_gym.errors import InvalidValueError, check_whole
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.arm_spheres import ArmSpheres, arm_spheres
from greenhouse_gym.motion.roadmap import RESOLUTION
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.scene.occupancy import FREE, UNKNOWN

ZONE = ((0.42, -1.2, -0.48), (0.95, 1.2, 0.08))
"""Corners of the space in which ripe fruit hang, in the base frame, metres: 98 % of it on the training rows."""

FRUIT_AT, FRUIT_SPREAD = (0.55, 0.0, -0.23), (0.15, 0.6, 0.12)
"""Center and standard deviations of the places of ripe fruit, metres, on the training rows."""

NOTHING, OPACITY = np.zeros(4), np.array([0.0, 0.0, 1.0, 1.0])
"""Fraction of light that is lost in a cell by its state: none at all, and as surfaces hide what is behind them."""

_GAP = 0.04  # metres between the arm and the centers of cells that are not known to be free
_ARRIVED, _SETTLED = 0.01, 0.03  # radians from a viewpoint, and between command and joints, for a view
_TRIED = 80  # viewpoints whose motions are checked
_NEAR = 2  # cells from known ones within which others are worth a view
_TRUSS, _IN_TRUSS = 2, 3.0  # cells from ripe skin within which fruit is so much more likely
_POINTS = 700  # unknown cells that are sampled for a view
_MIN_GAIN = 0.02  # fraction of the points that a view shows
_COLUMNS = (0.0, 0.4, -0.4, 0.8, -0.8)  # metres along the row: centers of the parts of fixed views
_FACING = 0.15  # fraction of the zone that random views show


class CarvedSpace:
    """Carved map, and the space that the arm has already occupied.

    Args:
        arm: The spheres of the arm.
        start: (j,) its first configuration, radians.
    """

    def __init__(self, arm: ArmSpheres, start: Array):
        self._arm = arm
        self._swept = arm.near(MAP.centers, start[None], MAP.cell + _GAP).reshape(MAP.shape)
        low, high = np.array(ZONE)
        self._in_zone = ((MAP.centers > low) & (MAP.centers < high)).all(axis=1).reshape(MAP.shape)
        self._likely = np.exp(-0.5 * (((MAP.centers - FRUIT_AT) / FRUIT_SPREAD) ** 2).sum(axis=1))
        self._shown = np.zeros(MAP.size)
        self.update(np.full(MAP.shape, UNKNOWN, dtype=np.uint8))

    def update(self, states: npt.NDArray[np.uint8]) -> None:
        """Adopt the states of the cells, `MAP.shape`."""
        self.states = states
        free = (states == FREE) | (self._swept & (states == UNKNOWN))
        self._distance = np.asarray(distance_transform_edt(free)).reshape(-1) * MAP.cell

    def shown(self, configurations: Array, points: Array, opacity: Array) -> Array:
        """Return the visibility (m, k), 0 to 1, of points (k, 3) to the camera in configurations (m, j).

        Args:
            configurations: Radians.
            points: Metres.
            opacity: Fraction of light that is lost in a cell, by its state.
        """
        from greenhouse_gym.motion.visibility_kernels import transmittances  # loads numba

        turns, origins = map(np.ascontiguousarray, wrist_camera(self._arm.chain, configurations))
        centers = np.ascontiguousarray(self._arm.centers(configurations))
        camera, result = DepthCamera(), np.empty((len(configurations), len(points)))
        limits = np.array([*DEPTHS, camera.width / 2 / camera.focal, camera.height / 2 / camera.focal])
        transmittances(
            turns, origins, centers, self._arm.radius, points, opacity[self.states.reshape(-1)], np.array(MAP.low),
            np.array(MAP.shape), MAP.cell, limits, result,
        )  # fmt: skip
        return result

    def admits(self, configurations: Array) -> bool:
        """Return whether an arm in configurations (m, j) is in free space, or in the aisle in front of the map."""
        moving = self._arm.moving
        centers, radius = self._arm.centers(configurations)[:, moving], self._arm.radius[moving]
        cells = MAP.indices(centers.reshape(-1, 3)).reshape(centers.shape[:2])
        in_aisle = centers[..., 0] < MAP.low[0]
        distance = np.where(cells >= 0, self._distance[cells], np.where(in_aisle, np.inf, 0.0))
        return bool((distance > radius + _GAP).all())

    def hiding(self) -> tuple[Array, Array]:
        """Return cells of the zone that may hide fruit: those near known ones that are not free; at first all of them.

        Returns:
            Their centers (k, 3), metres, and the probabilities (k,) that the next fruit is there. They are smaller for
            cells that views have shown, once for each view.
        """
        cells, known = self._in_zone & (self.states != FREE), self.states != UNKNOWN
        if known.any():
            cells &= binary_dilation(known, iterations=_NEAR)
        weight = np.where(binary_dilation(self.states == RIPE, iterations=_TRUSS), _IN_TRUSS, 1.0).reshape(-1)
        weight = (weight * self._likely * np.exp(-self._shown))[cells.reshape(-1)]
        return MAP.centers[cells.reshape(-1)], weight / max(weight.sum(), 1e-12)

    def note_view(self, joints: Array) -> None:
        """Note which cells a view shows that is taken in a configuration (j,), given the map after it."""
        cells = np.flatnonzero(self._in_zone & (self.states != FREE))
        self._shown[cells] += self.shown(joints[None], MAP.centers[cells], OPACITY)[0]

    def zone(self) -> Array:
        """Return the centers (k, 3) of the cells of the zone."""
        return np.asarray(MAP.centers[self._in_zone.reshape(-1)])


class LookingAgent(JointAgent, ABC):
    """Move from one viewpoint to the next through observed space, and take a view at each; the first at the start.

    It knows the carved map alone. Subclasses choose the viewpoints.

    Args:
        max_views: Number of views after which it holds still; None for no limit.

    Attributes:
        env_options: Puts the map into the observation.
    """

    env_options: Mapping[str, Any] = MappingProxyType({**JointAgent.env_options, "observation": "task"})

    def __init__(self, max_views: int | None = None) -> None:
        self._max_views = np.inf if max_views is None else check_whole("max_views", max_views, 1)
        self._problem: Problem | None = None

    def reset(self, problem: Problem) -> None:
        """Forget the last episode.

        Raises:
            InvalidValueError: The environment has another task.
        """
        if problem.controls != TomatoLook.controls:
            raise InvalidValueError(f"agent {self.name!r} looks for fruit: it needs task='look'")
        self._problem, self._arm = problem, arm_spheres(problem.robot)
        self._rng = np.random.default_rng(problem.seed)
        layout = TaskObservation(problem.robot, TomatoLook()).layout
        self._features = feature_slices(layout)
        self._space = CarvedSpace(self._arm, problem.start)
        self._goal: Array | None = problem.start
        self._trail: list[Array] = []
        self._views = 0

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """Return the next action, (joints + 1,)."""
        if self._problem is None:
            raise RuntimeError("reset the agent before it acts")
        joints, error = (
            observation["state"][self._features[name]].astype(np.float64)
            for name in ("joint_position", "command_error")
        )
        if self._views >= self._max_views:
            return np.zeros(len(joints) + 1, dtype=np.float32)
        command = np.clip(joints + error, self._problem.robot.lower, self._problem.robot.upper)
        if self._goal is None:
            self._space.update(observation["map"])
            self._space.note_view(joints)
            self._goal = self._next(command)
        move = action_towards(self._goal, command, self._problem.joint_steps)
        arrived = np.abs(self._goal - command).max() < _ARRIVED and np.abs(error).max() < _SETTLED
        if arrived:
            self._trail.append(self._goal)
            self._goal = None
            self._views += 1
        return np.append(move, float(arrived)).astype(np.float32)

    def _next(self, command: Array) -> Array:
        """Return the next viewpoint that a free motion leads to; else the one before the last."""
        for viewpoint in islice(self._viewpoints(command), 2 * _TRIED):
            if self._is_free(command, viewpoint):
                return viewpoint
        if len(self._trail) > 1:
            self._trail.pop()
            return self._trail.pop()
        return command

    def _is_free(self, command: Array, viewpoint: Array) -> bool:
        steps = 1 + int(np.abs(viewpoint - command).max() / 0.05)
        path = command + np.linspace(0, 1, steps + 1)[:, None] * (viewpoint - command)
        return self._space.admits(path) and self._arm.checker.motion_is_free(command, viewpoint, RESOLUTION)

    @abstractmethod
    def _viewpoints(self, command: Array) -> Iterator[Array]:
        """Yield viewpoints (j,) for the next view, the best first."""

    def _showing(self, command: Array, points: Array, min_gain: float, opacity: Array = NOTHING) -> Iterator[Array]:
        """Yield configurations that show many of some points (k, 3), best first.

        Args:
            command: (j,) current configuration, radians.
            points: The points.
            min_gain: Fraction of the points that must be shown.
            opacity: Fraction of light that is lost in a cell, by its state.
        """
        assert self._problem is not None
        sees = partial(self._space.shown, points=points, opacity=opacity)
        return (viewpoint for viewpoint, _ in viewpoints(self._problem.robot, command, sees, self._rng, min_gain))


class NextBestViewAgent(LookingAgent):
    """Take the view that shows most of the cells that may hide fruit (next best view; Connolly, 1985).

    These are cells near known ones that are not free. They count by the places of ripe fruit on the training rows, more
    near ripe skin, because fruit hang in trusses, and less with every view that has shown them.
    """

    name = "next-best-view"

    def _viewpoints(self, command: Array) -> Iterator[Array]:
        points, likely = self._space.hiding()
        points = points[self._rng.choice(len(points), _POINTS, p=likely)] if len(points) else self._space.zone()
        return self._showing(command, points, _MIN_GAIN, OPACITY)


class FixedViewsAgent(LookingAgent):
    """Take views of ten parts of the zone in a fixed order: five columns, each low and high, from the middle out.

    A part that no free motion leads to yet is left out.
    """

    name = "fixed-views"

    def reset(self, problem: Problem) -> None:
        """Begin with the first part."""
        super().reset(problem)
        self._part = 0

    def _viewpoints(self, command: Array) -> Iterator[Array]:
        points = self._space.zone()
        upper = points[:, 2] > np.mean([ZONE[0][2], ZONE[1][2]])
        for _ in range(2 * len(_COLUMNS)):
            column, row = divmod(self._part, 2)
            self._part = (self._part + 1) % (2 * len(_COLUMNS))
            part = points[(upper == row) & (np.abs(points[:, 1] - _COLUMNS[column]) < 0.2)]
            yield from islice(self._showing(command, part, 0.5), _TRIED // len(_COLUMNS))


class RandomViewsAgent(LookingAgent):
    """Take random views that show a part of the zone."""

    name = "random-views"

    def _viewpoints(self, command: Array) -> Iterator[Array]:
        points = self._space.zone()
        points = points[self._rng.permutation(len(points))[:_POINTS]]
        found = list(self._showing(command, points, _FACING))
        return (found[k] for k in self._rng.permutation(len(found)))
