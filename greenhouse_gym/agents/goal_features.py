"""Additional inputs of goal-conditioned networks: the pose of the tool relative to its goal."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.features import Layout, feature_slices
from greenhouse_gym.errors import InvalidValueError

GOAL_FEATURES, GOAL_FEATURES_SIZE = "goal_features", 18
"""Name and size of this group in the layout of such a network's input."""

_PARTS = ("observation", "achieved_goal", "desired_goal")


def goal_features(
    seen: Any, achieved: Any, desired: Any, at: Mapping[str, slice], lengths: Callable[[Any], Any]
) -> list[Any]:
    """Return features of the tool relative to its goal, scaled to about one: arrays or tensors (..., k), as the inputs.

    Hindsight goals are in free air, where every obstacle must be avoided. Real goals are inside a fruit, which the
    clearances include as an obstacle. So the features contain the distance of the cup from the skin of a fruit around
    the goal, and the clearance at the tip beyond that: zero means that the nearest obstacle is the target.

    Args:
        seen: (..., size) the goal environment's ``"observation"``.
        achieved: (..., 3) its achieved goal, metres.
        desired: (..., 3) its desired goal, metres.
        at: Slice of each group in the observation.
        lengths: Returns lengths (..., 1) of vectors (..., 3).
    """
    tip, axis = seen[..., at["tip_position"]], seen[..., at["tool_axis"]]
    clearance = seen[..., at["clearance"]][..., -1:]
    offset, ahead = desired - achieved, desired - tip
    radius, distance, from_tip = (lengths(v) for v in (achieved - tip, offset, ahead))
    gap = from_tip - radius
    return [
        2.0 * achieved,
        2.0 * desired,
        4.0 * offset,
        (20.0 * offset).clip(-2.0, 2.0),  # fine resolution near the goal, where centimetres matter
        2.0 * distance,
        (20.0 * distance).clip(max=3.0),
        10.0 * radius,
        (10.0 * gap).clip(-3.0, 3.0),
        (10.0 * (clearance - gap)).clip(-3.0, 3.0),
        (ahead * axis).sum(-1, keepdims=True) / (from_tip + 1e-3),
    ]


def flaw_of(layout: Layout) -> str:
    """Return the reason why a layout with these features is invalid; empty if it is valid or has no such features."""
    names = [name for name, _ in layout]
    if GOAL_FEATURES not in names:
        return ""
    if layout[-1] != (GOAL_FEATURES, GOAL_FEATURES_SIZE) or names.count(GOAL_FEATURES) > 1:
        return f"{GOAL_FEATURES} must be the last group of the observation_layout, with {GOAL_FEATURES_SIZE} entries"
    sizes = dict(layout)
    for name, min_size in (("tip_position", 3), ("tool_axis", 3), ("clearance", 1)):
        if sizes.get(name, 0) < min_size:
            return f"{GOAL_FEATURES} needs a group {name!r} of {min_size} entries or more in the observation_layout"
    return ""


def goal_vector(observation: Mapping[str, npt.ArrayLike], layout: Layout) -> npt.NDArray[np.float32]:
    """Return a network's input for a goal environment's observation: the vector and these features, (..., size + 18).

    Args:
        observation: The observation, or those of several simulations, stacked by key.
        layout: Layout of the input.

    Raises:
        InvalidValueError: It is not an observation of a goal environment.
    """
    if not isinstance(observation, Mapping) or not set(_PARTS) <= set(observation):
        got = list(observation) if isinstance(observation, Mapping) else type(observation).__name__
        raise InvalidValueError(f"expected a goal environment's observation, a dict of {', '.join(_PARTS)}, got {got}")
    seen, achieved, desired = (np.asarray(observation[name], dtype=np.float32) for name in _PARTS)
    features = goal_features(seen, achieved, desired, feature_slices(layout), _lengths)
    return np.concatenate([seen, *features], axis=-1, dtype=np.float32)


def _lengths(vectors: npt.NDArray[np.float32]) -> Any:
    return np.linalg.norm(vectors, axis=-1, keepdims=True)
