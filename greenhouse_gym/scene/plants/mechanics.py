"""Mechanics of compliant plants: parameters, and mass properties of bodies made of shapes."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import mujoco
import numpy as np

from greenhouse_gym.errors import InvalidValueError, is_number
from greenhouse_gym.geometry import Array, ShapeArrays
from greenhouse_gym.geometry.shape_arrays import BOX, CAPSULE
from greenhouse_gym.scene.obstacle_slots import geoms_of

GRAVITY = 9.81
"""Standard gravity, m/s^2."""


@dataclass(frozen=True)
class PlantMechanics:
    """Mechanical parameters of plants, a gripper and damage.

    Values without a source are priors: published stiffnesses scatter widely, and the weight of the fruit governs a
    truss much more than its stiffness.

    Attributes:
        density: Density of fruit and stems, kg/m^3.
        leaf_mass: Mass of a leaf per area, kg/m^2.
        truss_stiffness: Stiffness of a peduncle's base against bending, N m/rad.
        leaf_stiffness: Stiffness of a petiole's base, N m/rad.
        pedicel_stiffness: Stiffness of a pedicel, N m/rad.
        damping_ratio: Ratio of critical damping at which organs swing.
        max_sag: Bend from the unloaded to the hanging pose, radians, above which an organ is made stiffer: gravity
            must not hold it at the end of a spring.
        pull_limit: Pull beyond its own weight that takes off an unbent fruit, N. Abscission forces of cherry tomatoes
            are 5 to 8 N.
        bend_limit: Bend of the pedicel that takes off a fruit without pull, radians. Bending needs less force.
        cup_limit: Force at which the suction cup lets go, N.
        grip_limit: Force at which a cutter lets go of a truss, N.
        press_limit: Mean pressing force during an action that damages what does not move, or a fruit, N. Half the
            puncture force of ripe skin and more.
        truss_bend_limit: Bend of a peduncle that damages it, radians.
        leaf_bend_limit: Bend of a petiole that damages it, radians.
    """

    density: float = 950.0
    leaf_mass: float = 0.25
    truss_stiffness: float = 0.15
    leaf_stiffness: float = 0.09
    pedicel_stiffness: float = 0.02
    damping_ratio: float = 0.15
    max_sag: float = 0.6
    pull_limit: float = 8.0
    bend_limit: float = np.pi / 3
    cup_limit: float = 18.0
    grip_limit: float = 40.0
    press_limit: float = 10.0
    truss_bend_limit: float = 1.1
    leaf_bend_limit: float = 1.3

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (is_number(value) and value > 0):
                raise InvalidValueError(f"PlantMechanics.{field.name} must be a positive number, got {value!r}")

    def scaled(self, factors: Array) -> PlantMechanics:
        """Return mechanics whose `VARYING` values are multiplied by factors (k,)."""
        changed = {name: float(getattr(self, name) * f) for name, f in zip(VARYING, factors, strict=True) if f != 1}
        return replace(self, **changed) if changed else self


VARYING = (
    "density", "leaf_mass", "truss_stiffness", "leaf_stiffness", "pedicel_stiffness", "damping_ratio", "pull_limit",
    "bend_limit",
)  # fmt: skip
"""Parameters that differ between plants."""

HINGE_ARMATURE, BALL_ARMATURE = 3e-4, 3e-5
"""Minimum inertia about a hinge of a truss or leaf, and about a pedicel, kg m^2; less is unstable at 10 ms."""

HINGE_RANGE = np.pi / 2
"""Largest bend of a truss or leaf about each axis, radians."""


class MassProperties(NamedTuple):
    """Mass properties of a body.

    Attributes:
        mass: Mass, kg.
        center: (3,) center of mass, metres.
        inertia: (3,) principal moments about it, kg m^2.
        quat: (4,) rotation of the principal axes.
    """

    mass: float
    center: Array
    inertia: Array
    quat: Array


def mass_properties(shapes: ShapeArrays, mechanics: PlantMechanics) -> MassProperties:
    """Return the mass properties of shapes that form one body, boxes taken as leaves."""
    kinds, positions, sizes, quats = geoms_of(shapes)
    masses, moments = np.zeros(len(kinds)), np.zeros((len(kinds), 3))
    for k, (kind, size) in enumerate(zip(kinds, sizes, strict=True)):
        masses[k], moments[k] = _of_shape(int(kind), size, mechanics)
    mass = float(masses.sum())
    center = masses @ positions / mass
    total, rotation = np.zeros((3, 3)), np.empty(9)
    for m, moment, position, quat in zip(masses, moments, positions - center, quats, strict=True):
        mujoco.mju_quat2Mat(rotation, quat)
        turn = rotation.reshape(3, 3)
        total += turn @ np.diag(moment) @ turn.T + m * (position @ position * np.eye(3) - np.outer(position, position))
    values, axes = np.linalg.eigh(total)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(axes).reshape(-1))
    return MassProperties(mass, center, values, quat)


def _of_shape(kind: int, size: Array, mechanics: PlantMechanics) -> tuple[float, Array]:
    """Return mass and principal moments of a shape about its middle."""
    if kind == BOX:
        a, b = np.sort(size)[1:]
        mass = mechanics.leaf_mass * 4 * a * b
        return mass, mass / 3 * (size @ size - size**2)
    if kind == CAPSULE:
        radius, length = size[0], 2 * size[1]
        tube, ends = np.pi * radius**2 * length * mechanics.density, 4 / 3 * np.pi * radius**3 * mechanics.density
        across = tube * (3 * radius**2 + length**2) / 12
        across += ends * (0.4 * radius**2 + length**2 / 4 + 3 / 8 * length * radius)
        return tube + ends, np.array([across, across, tube * radius**2 / 2 + ends * 0.4 * radius**2])
    axes = size if size[1] > 0 else np.full(3, size[0])
    mass = 4 / 3 * np.pi * axes.prod() * mechanics.density
    return mass, mass / 5 * (axes @ axes - axes**2)
