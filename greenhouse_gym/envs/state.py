"""State and timing of n simulations.

All arrays are computed elementwise, so the numbers of one simulation do not depend on how many are computed together.
Points and directions are in the base frame: x forward to the plants, z up, origin at the arm's base on its stand.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.distance_field import FieldsOfSimulations
from greenhouse_gym.scene.mjcf import TIMESTEP

Float32: TypeAlias = npt.NDArray[np.float32]
Bools: TypeAlias = npt.NDArray[np.bool_]
Bytes: TypeAlias = npt.NDArray[np.uint8]
Ids: TypeAlias = npt.NDArray[np.int64]

STEP_LIMIT = 200
"""Default number of steps after which an episode is truncated."""

RATE = 20
"""Default number of actions per second."""

SUBSTEPS = 5
"""Physics steps of 10 ms per action at the default rate."""

ACTION_STEP = 0.08
"""Change of a joint's command by an action of 1 at the default rate, radians."""

MAX_COMMAND_ERROR = 0.2
"""Maximum distance of a command from the measured joint position at the default rate, radians.

At full speed the arm lags 0.1 rad behind its commands.
"""


HIDDEN = "_"
"""Beginning of the names in `State.memory` that only the task and its rewards know."""


class ControlTiming(NamedTuple):
    """Timing of actions and physics steps.

    Attributes:
        substeps: Physics steps per action.
        interval: Time between two actions, seconds.
        action_step: Change of a joint's command by an action of 1, radians.
    """

    substeps: int = SUBSTEPS
    interval: float = SUBSTEPS * TIMESTEP
    action_step: float = ACTION_STEP


DEFAULT_TIMING = ControlTiming()


def control_timing(rate: float) -> ControlTiming:
    """Return the timing for a number of actions per second; the maximum joint speed is the same at every rate."""
    substeps = round(1 / (rate * TIMESTEP))
    return ControlTiming(substeps, substeps * TIMESTEP, ACTION_STEP * (substeps / SUBSTEPS))


PLANTS: Mapping[str, str] = MappingProxyType(
    {
        "work": "number of the fruit in work: the held one, else the nearest one to be picked; -1 without one",
        "fruit": "(3,) its middle in the base frame, metres; the tip without one",
        "radius": "its radius, metres",
        "joint": "(3,) start of its pedicel on the truss, metres; with a cutter the point to cut",
        "hangs": "1 while it hangs on its pedicel or peduncle",
        "held": "1 while the cup holds a fruit",
        "vacuum": "reading of the vacuum: 1 at rest on a fruit, falling to 0 at the force at which the cup lets go",
        "force": "(3,) mean force of the held fruit on the cup in the last action, N",
        "left": "fruit to be picked that are neither in the crate nor lost",
        "wanted": "fruit to be picked in the episode",
        "detached": "fruit to be picked that came off in the cup in the last action",
        "knocked": "fruit that came off otherwise",
        "crated": "fruit to be picked that came to rest in the crate",
        "dropped": "fruit that came off in the cup and were lost",
        "damaged": "organs damaged for the first time",
        "crate": "(3,) middle of the crate's rim, metres",
    }
)
"""Numbers on compliant plants and the gripper in `State.plants`, by name with their meanings."""


class State(NamedTuple):
    """State of n simulations at one moment.

    Attributes:
        joints: (n, j) measured joint positions, radians.
        velocities: (n, j) joint velocities, rad/s.
        command_error: (n, j) last commanded minus measured joint positions, radians.
        tip: (n, 3) center of the suction cup, metres.
        axis: (n, 3) unit vector along the tool.
        grasp: (n, 3) grasp point, one target radius ahead of the tip, metres.
        target: (n, 3) center of the current target as the agent knows it, metres.
        goal: (n, 3) true center of the current target, metres. It differs from ``target`` if the physics simulate the
            true row or the target is observed with an error.
        remaining: (n,) targets left in the episode, the current one included.
        clearance: (n, k) distance from the arm's surface at its probe points to the nearest obstacle, metres.
        obstacle: (n, k, 3) unit vectors from the probe points to that obstacle; zero beyond the maximum distance.
        waypoint: (n, j) offset from the commanded joints to the roadmap's waypoint, radians; (n, 0) unless requested.
        path_length: (n,) length of the path from the waypoint to the goal, radians; NaN unless requested.
        path_free: (n,) whether the straight motion to the waypoint is collision-free; False unless requested.
        unknown: (n, k) whether the probe points lie in space that the scan did not observe; k is 0 unless requested.
        depth: (n, c, h, w) depth images of c cameras, metres; 0 without a reading.
        color: (n, c, h, w, 3) color images, 0 to 255; c is 0 unless requested.
        views: (n, c, 4, 4) camera poses, base_from_camera.
        fields: Distance fields of the known scenes, for `distances_at`.
        plants: Numbers on compliant plants and the gripper by name, (n,) or (n, 3), see `PLANTS`; empty if plants are
            rigid.
        contacts: (n, `len(CONTACT_GROUPS)`) contacts by group, summed over the physics steps of the last action.
        collided: (n,) whether a contact ended the episode.
        distance: (n,) remaining distance to the goal as the task measures it.
        success: (n,) whether the task is solved.
        failure: (n,) whether the task has failed.
        memory: Numbers (n,) and arrays (n, ...) of the task by name, see `Task.memory`.
    """

    joints: Array
    velocities: Array
    command_error: Array
    tip: Array
    axis: Array
    grasp: Array
    target: Array
    goal: Array
    remaining: npt.NDArray[np.int64]
    clearance: Float32
    obstacle: Float32
    waypoint: Array
    path_length: Array
    path_free: Bools
    unknown: Bools
    depth: Float32
    color: Bytes
    views: Array
    fields: FieldsOfSimulations
    plants: Mapping[str, Array]
    contacts: npt.NDArray[np.int64]
    collided: Bools
    distance: Array
    success: Bools
    failure: Bools
    memory: Mapping[str, Array]

    def distances_at(self, points: Array) -> tuple[Float32, Float32]:
        """Return distances and directions from points to the nearest obstacle of the known scenes.

        The target is no obstacle unless the observation has a true ``target_is_obstacle``. The distances come from a
        grid (`greenhouse_gym.motion.distance_field`), and are valid until a simulation's next episode.

        Args:
            points: (n, k, 3) points in the base frame, metres.

        Returns:
            Distances (n, k), metres, at most `MAX_DISTANCE`, and unit vectors (n, k, 3) toward the obstacle, zero where
            the distance is capped.

        Raises:
            InvalidValueError: The points have another shape or are not finite.
        """
        array = np.asarray(points, dtype=np.float64)
        if array.ndim != 3 or array.shape[::2] != (len(self.joints), 3) or not np.isfinite(array).all():
            raise InvalidValueError(
                f"points must be finite numbers of shape ({len(self.joints)}, k, 3), got shape {array.shape}"
            )
        return self.fields.lookup(array)

    def with_outcome(self, distance: Array, success: Bools, failure: Bools, memory: Mapping[str, Array]) -> State:
        """Return the state with the outcome of the task, its last four fields (faster than ``_replace``)."""
        return State(*self[:-4], distance, success, failure, memory)

    def known(self, hidden: bool) -> State:
        """Return the state as observations and actions may know it; changes to its outcome have no effect.

        Args:
            hidden: The true goal differs from the target. The outcome, which depends on it, is then left out as well.
        """
        memory = {name: values.copy() for name, values in self.memory.items() if not name.startswith(HIDDEN)}
        seen = self._replace(goal=self.target.copy(), contacts=self.contacts.copy(), collided=self.collided.copy())
        if not hidden:
            return seen.with_outcome(self.distance.copy(), self.success.copy(), self.failure.copy(), memory)
        undecided = np.zeros(len(self.success), dtype=np.bool_)
        return seen.with_outcome(np.full(len(undecided), np.nan), undecided, undecided.copy(), memory)

    def select(self, ids: Ids) -> State:
        """Return the state of some simulations."""
        taken = (v if v is self.fields else _mapped(v, lambda array: array[ids]) for v in self)
        return State._make(taken)._replace(fields=self.fields.select(ids))

    def replaced(self, ids: Ids, fresh: State) -> State:
        """Return a copy with the ``fresh`` state of some simulations."""
        result = State._make(v if v is self.fields else _mapped(v, np.copy) for v in self)
        old: Any
        new: Any
        for old, new in zip(result, fresh, strict=True):
            if old is not self.fields:
                _replace(old, ids, new)
        return result._replace(fields=self.fields.replaced(ids, fresh.fields))


def _replace(old: Any, ids: Ids, new: Any) -> None:
    """Replace the rows of some simulations in an array, or in each array of a mapping."""
    if isinstance(old, Mapping):
        for name, values in old.items():
            values[ids] = new[name]
    else:
        old[ids] = new


def _mapped(values: Any, function: Callable[[npt.NDArray[Any]], npt.NDArray[Any]]) -> Any:
    """Apply a function to an array, or to each array of a mapping."""
    if isinstance(values, Mapping):
        return {name: function(array) for name, array in values.items()}
    return function(values)


def lengths(vectors: Array) -> Array:
    """Return the lengths (n,) of vectors (n, 3)."""
    squares = vectors * vectors
    return np.asarray(np.sqrt(squares[:, 0] + squares[:, 1] + squares[:, 2]))
