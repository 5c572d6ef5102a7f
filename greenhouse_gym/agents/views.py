"""From where a camera at the wrist could see given places: a small next-best-view search (Connolly, 1985)."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.sight_map import wrist_camera
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.arm_spheres import ArmBalls
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.robots import Robot

VIEWS, SPREADS = 400, (0.24, 1.2)
"""Configurations that are tried, and how far their joints are strewn about where the arm is, from and to, radians."""

WORTH = 0.2
"""Share of the places that a view must show."""

DEPTHS, NOISY_DEPTHS = (0.1, 1.2), (0.2, 1.0)
"""Depths at which a place is seen well, by a perfect camera and by one with the noise of a D435, metres."""

_PARTS = 10  # parts in which the configurations are looked at, which take less memory than all
_MOVE = 0.1  # share of the places that is worth a motion of a radian
_EDGE = 0.95  # share of the image in which a place counts as shown
_STEP, _SHORT = 0.04, 0.08  # metres between places looked at along a ray, and before its end where it may be hidden

Seen = npt.NDArray[np.bool_]


def views(
    arm: ArmBalls,
    robot: Robot,
    command: Array,
    places: Array,
    hidden: Callable[[Array], Seen],
    random: np.random.Generator,
    depths: tuple[float, float] = DEPTHS,
) -> Iterator[tuple[Array, Seen]]:
    """Configurations (j,) from which the camera sees many places, and which of these it sees, the best first.

    Args:
        arm: The arm.
        robot: The same arm.
        command: (j,) where it is, radians.
        places: (k, 3) what is to be seen, in the frame of its base, metres.
        hidden: Which of places (n, 3) are in something that hides what is behind it, (n,).
        random: Strews the configurations that are tried.
        depths: At which a place is seen well, from and to, metres.
    """
    spreads = np.linspace(*SPREADS, VIEWS)[:, None]
    tried = np.clip(command + spreads * random.normal(size=(VIEWS, len(command))), robot.lower, robot.upper)
    tried[:, -1] = command[-1]  # the tool need not turn
    seen = np.concatenate([visible(arm, some, places, hidden, depths) for some in np.split(tried, _PARTS)])
    gains = seen.mean(axis=1)
    costs = np.where(gains < WORTH, np.inf, _MOVE * np.abs(tried - command).max(axis=1) - gains)
    for k in costs.argsort(kind="stable")[: np.isfinite(costs).sum()]:
        yield tried[k], seen[k]


def visible(
    arm: ArmBalls,
    configurations: Array,
    places: Array,
    hidden: Callable[[Array], Seen],
    depths: tuple[float, float] = DEPTHS,
) -> Seen:
    """Which of places (k, 3) the camera sees at such depths from configurations (m, j): (m, k)."""
    turn, origin = wrist_camera(arm.chain, configurations)
    away = places - origin[:, None]
    x, y, z = np.moveaxis(np.einsum("mkx,mxy->mky", away, turn), -1, 0)
    camera = DepthCamera()
    wide, high = (_EDGE * size / 2 / camera.focal for size in (camera.width, camera.height))
    seen = np.asarray((z > depths[0]) & (z < depths[1]) & (np.abs(x) < wide * z) & (np.abs(y) < high * z))
    m, k = np.nonzero(seen)
    length = np.linalg.norm(away[m, k], axis=1)[:, None]
    along = np.arange(_STEP, float(length.max(initial=0.0)), _STEP)
    between = along < length - _SHORT
    rays = origin[m][:, None] + away[m, k][:, None] * (along[:, None] / length[..., None])
    in_front = np.zeros(between.shape, dtype=np.bool_)
    in_front[between] = hidden(rays[between])
    seen[m, k] = ~in_front.any(axis=1)
    return seen
