"""What a network that reaches for goals is fed beside the observation: how the tool lies to its goal."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.features import Layout, feature_slices
from greenhouse_gym.errors import InvalidValueError

GOAL_FEATURES, GOAL_FEATURES_SIZE = "goal_features", 18
"""Name and number of entries of this group in the layout of what such a network is fed."""

_PARTS = ("observation", "achieved_goal", "desired_goal")


def goal_features(
    seen: Any, achieved: Any, desired: Any, at: Mapping[str, slice], lengths: Callable[[Any], Any]
) -> list[Any]:
    """How the tool lies to its goal, brought to about one: arrays (..., k) or tensors, as those that are given.

    Goals in hindsight are in free air, where the nearest obstacle is always to be avoided. Real ones are inside a fruit
    that the clearances count. So the features tell how far the cup is from the skin of a fruit around the goal, and
    what the clearance at the tip is beyond that: zero says that the nearest obstacle is the target.

    Args:
        seen: (..., size) the goal environment's ``"observation"``.
        achieved: (..., 3) its achieved goal, metres.
        desired: (..., 3) its desired goal, metres.
        at: Where each group lies in what is seen.
        lengths: Makes lengths (..., 1) of vectors (..., 3).
    """
    tip, axis = seen[..., at["tip_position"]], seen[..., at["tool_axis"]]
    clearance = seen[..., at["clearance"]][..., -1:]
    way, ahead = desired - achieved, desired - tip
    radius, distance, from_tip = (lengths(v) for v in (achieved - tip, way, ahead))
    gap = from_tip - radius
    return [
        2.0 * achieved,
        2.0 * desired,
        4.0 * way,
        (20.0 * way).clip(-2.0, 2.0),  # fine near the goal, where centimetres decide
        2.0 * distance,
        (20.0 * distance).clip(max=3.0),
        10.0 * radius,
        (10.0 * gap).clip(-3.0, 3.0),
        (10.0 * (clearance - gap)).clip(-3.0, 3.0),
        (ahead * axis).sum(-1, keepdims=True) / (from_tip + 1e-3),
    ]


def flaw_of(layout: Layout) -> str:
    """Why a layout cannot be that of a network that is fed these features; empty if it can, or is not."""
    names = [name for name, _ in layout]
    if GOAL_FEATURES not in names:
        return ""
    if layout[-1] != (GOAL_FEATURES, GOAL_FEATURES_SIZE) or names.count(GOAL_FEATURES) > 1:
        return f"{GOAL_FEATURES} must be the last group of the observation_layout, with {GOAL_FEATURES_SIZE} entries"
    sizes = dict(layout)
    for name, least in (("tip_position", 3), ("tool_axis", 3), ("clearance", 1)):
        if sizes.get(name, 0) < least:
            return f"{GOAL_FEATURES} needs a group {name!r} of {least} entries or more in the observation_layout"
    return ""


def goal_vector(observation: Mapping[str, npt.ArrayLike], layout: Layout) -> npt.NDArray[np.float32]:
    """What a network is fed of a goal environment's observation: the vector and these features, (..., size + 18).

    Args:
        observation: The observation, or those of several simulations, stacked by key.
        layout: Layout of the vector; what comes after its groups is left out.

    Raises:
        InvalidValueError: It is not the observation of a goal environment.
    """
    if not isinstance(observation, Mapping) or not set(_PARTS) <= set(observation):
        got = list(observation) if isinstance(observation, Mapping) else type(observation).__name__
        raise InvalidValueError(f"expected a goal environment's observation, a dict of {', '.join(_PARTS)}, got {got}")
    seen, achieved, desired = (np.asarray(observation[name], dtype=np.float32) for name in _PARTS)
    told = goal_features(seen, achieved, desired, feature_slices(layout), _lengths)
    return np.concatenate([seen, *told], axis=-1, dtype=np.float32)


def _lengths(vectors: npt.NDArray[np.float32]) -> Any:
    return np.linalg.norm(vectors, axis=-1, keepdims=True)
