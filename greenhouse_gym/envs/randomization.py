"""Domain randomization, off by default and drawn from the seed of the episode."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from typing import NamedTuple

import mujoco
import numpy as np

from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.plants.mechanics import VARYING


@dataclass(frozen=True)
class Randomization:
    """Ranges of domain randomization; each value is drawn uniformly within plus and minus its range.

    Attributes:
        base_position: Shift of the arm's base on its stand along x and y, metres. Positions are still observed in the
            frame of the stand.
        base_yaw: Rotation of the arm's base on its stand, radians.
        joint_offset: Error of the observed joint positions, radians per joint.
        target_position: Error of the observed target position along each axis, metres.
        depth_noise: Depth images have the noise of a D435.
        mechanics: Relative change, below 1, of each of `greenhouse_gym.scene.plants.mechanics.VARYING`, for
            ``plants="compliant"``.
        plants: Motion of the true plants since the scan, for ``physics="truth"``; None for none. The scene that agents
            observe and plan in stays as it was scanned.
    """

    base_position: float = 0.0
    base_yaw: float = 0.0
    joint_offset: float = 0.0
    target_position: float = 0.0
    depth_noise: bool = False
    mechanics: float = 0.0
    plants: PlantMotion | None = None

    def __post_init__(self) -> None:
        if not (self.plants is None or isinstance(self.plants, PlantMotion)):
            raise InvalidValueError(f"randomization plants must be a PlantMotion or None, got {self.plants!r}")
        for field in fields(self):
            if field.name == "plants":
                continue
            value = getattr(self, field.name)
            real = isinstance(value, int | float | np.integer | np.floating | np.bool_)
            if not (real and 0 <= value <= sys.float_info.max):
                raise InvalidValueError(f"randomization {field.name} must be a number from 0 up, got {value!r}")
        if self.mechanics >= 1:
            raise InvalidValueError(f"randomization mechanics must be below 1, got {self.mechanics!r}")


NO_RANDOMIZATION = Randomization()
"""No randomization."""


class Disturbance(NamedTuple):
    """Randomization of one episode.

    Attributes:
        shift: (2,) shift of the base, metres.
        yaw: Rotation of the base, radians.
        joints: (j,) error added to the observed joint positions, radians.
        target: (3,) error added to the observed target, metres.
        noise: Generator of the depth noise, or None.
        plants: Seed of the plants' motion, or None.
        mechanics: (k,) factors of `greenhouse_gym.scene.plants.mechanics.VARYING`.
    """

    shift: Array
    yaw: float
    joints: Array
    target: Array
    noise: np.random.Generator | None
    plants: int | None
    mechanics: Array


def draw_disturbance(settings: Randomization, joints: int, rng: np.random.Generator) -> Disturbance:
    """Draw the disturbance of an episode; ranges of zero draw no random numbers, so that seeds keep their meaning."""

    def uniform(size: float, shape: int) -> Array:
        return rng.uniform(-size, size, shape) if size else np.zeros(shape)

    return Disturbance(
        shift=uniform(settings.base_position, 2),
        yaw=float(uniform(settings.base_yaw, 1)[0]),
        joints=uniform(settings.joint_offset, joints),
        target=uniform(settings.target_position, 3),
        noise=np.random.default_rng(rng.integers(2**63)) if settings.depth_noise else None,
        plants=None if settings.plants is None else int(rng.integers(2**63)),
        mechanics=1 + uniform(settings.mechanics, len(VARYING)),
    )


def displace_base(model: mujoco.MjModel, heading: Array, shift: Array, yaw: float) -> None:
    """Displace the arm of a freshly loaded model on its stand, whose ``heading`` (2,) is given as cosine and sine."""
    cosine, sine = heading
    model.body_pos[1, 0] += cosine * shift[0] - sine * shift[1]
    model.body_pos[1, 1] += sine * shift[0] + cosine * shift[1]
    turned = np.empty(4)
    mujoco.mju_mulQuat(turned, np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]), model.body_quat[1].copy())
    model.body_quat[1] = turned
