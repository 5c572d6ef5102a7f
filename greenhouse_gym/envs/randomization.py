"""Domain randomization: what an episode gets wrong on purpose, off by default and drawn from the episode's seed."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import mujoco
import numpy as np

from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array


@dataclass(frozen=True)
class Randomization:
    """How far an episode may be off; each figure is drawn uniformly within plus and minus its size.

    Attributes:
        base_position: Shift of the arm's base on its stand along x and y, metres. Positions are still told in the frame
            of the stand.
        base_yaw: Turn of the arm's base on its stand, radians.
        joint_offset: Error of the joint positions that are observed, radians per joint.
        target_position: Error of the target's position that is observed, metres along each axis.
        depth_noise: Whether depth images carry the noise of a D435.
        plants: How far the plants have moved since they were scanned, for ``physics="truth"``; None for not at all. The
            scene that is observed and planned in stays as it was scanned.
    """

    base_position: float = 0.0
    base_yaw: float = 0.0
    joint_offset: float = 0.0
    target_position: float = 0.0
    depth_noise: bool = False
    plants: PlantMotion | None = None

    def __post_init__(self) -> None:
        if not (self.plants is None or isinstance(self.plants, PlantMotion)):
            raise InvalidValueError(f"randomization plants must be a PlantMotion or None, got {self.plants!r}")
        for field in fields(self):
            if field.name == "plants":
                continue
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0):
                raise InvalidValueError(f"randomization {field.name} must be a number from 0 up, got {value!r}")


NO_RANDOMIZATION = Randomization()
"""Nothing is randomized: everything is as it is told."""


class Disturbance(NamedTuple):
    """What was drawn for an episode.

    Attributes:
        shift: (2,) shift of the base, metres.
        yaw: Turn of the base, radians.
        joints: (j,) added to the observed joint positions, radians.
        target: (3,) added to the observed target, metres.
        noise: Generator of the depth images' noise, or None.
        plants: Seed of the plants' motion, or None.
    """

    shift: Array
    yaw: float
    joints: Array
    target: Array
    noise: np.random.Generator | None
    plants: int | None


def draw_disturbance(settings: Randomization, joints: int, random: np.random.Generator) -> Disturbance:
    """Draw an episode's disturbance; what is off draws nothing, so that seeds keep their meaning."""

    def uniform(size: float, shape: int) -> Array:
        return random.uniform(-size, size, shape) if size else np.zeros(shape)

    return Disturbance(
        shift=uniform(settings.base_position, 2),
        yaw=float(uniform(settings.base_yaw, 1)[0]),
        joints=uniform(settings.joint_offset, joints),
        target=uniform(settings.target_position, 3),
        noise=np.random.default_rng(random.integers(2**63)) if settings.depth_noise else None,
        plants=None if settings.plants is None else int(random.integers(2**63)),
    )


def displace_base(model: mujoco.MjModel, heading: Array, shift: Array, yaw: float) -> None:
    """Move the arm of a freshly loaded model on its stand; ``heading`` (2,) is the stand's, as cosine and sine."""
    cosine, sine = heading
    model.body_pos[1, 0] += cosine * shift[0] - sine * shift[1]
    model.body_pos[1, 1] += sine * shift[0] + cosine * shift[1]
    turned = np.empty(4)
    mujoco.mju_mulQuat(turned, np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]), model.body_quat[1].copy())
    model.body_quat[1] = turned
