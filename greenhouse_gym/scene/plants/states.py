"""States of fruit on live plants, and what is known about them from action to action."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array

WAITING, EMPTY, HANGING, LOOSE, CRATED, LOST = -2, -1, 0, 1, 2, 3
"""States of a fruit: on a truss that has no slot, no fruit at all, on a truss in a slot, off it and on the move, at
rest in the crate, at rest or on the floor elsewhere."""


class Felt(NamedTuple):
    """Events among the plants of a simulation in an action.

    Attributes:
        force: (3,) mean force of the held fruit on the cup, N, in the scene.
        detached: Number of fruit to be picked that came off in the cup.
        knocked: Number of fruit that came off otherwise.
        crated: Number of fruit to be picked that came to rest in the crate.
        dropped: Number of fruit that came off in the cup and were lost.
        damaged: Number of organs damaged for the first time.
    """

    force: Array
    detached: int = 0
    knocked: int = 0
    crated: int = 0
    dropped: int = 0
    damaged: int = 0


class Work(NamedTuple):
    """Fruit or truss in work.

    Attributes:
        number: Its number among the fruit or trusses; -1 without one.
        point: (3,) where the tool has to go, or the middle of what it holds, metres.
        radius: Radius of what is at the point, metres.
        joint: (3,) start of the pedicel of the fruit, or the point to cut, metres.
        hangs: True unless it came off.
    """

    number: int
    point: Array
    radius: float
    joint: Array
    hangs: bool


class InReach(NamedTuple):
    """Fruit that the tool may go to, as long as none changes its state or body.

    Attributes:
        key: States and bodies of all fruit.
        left: Number of fruit to be picked that are neither in the crate nor lost.
        wanted: (m,) fruit to be picked that hang.
        geoms: (m,) their geoms.
        radii: Radii of spheres of their volumes, metres.
        loose: (k,) fruit that hang in slots or are on the move.
        loose_geoms: (k,) their geoms.
        reaches: (k,) distance of the tip from their middles from which the cup may seal on them, metres.
    """

    key: tuple[bytes, bytes]
    left: int
    wanted: npt.NDArray[np.int64]
    geoms: npt.NDArray[np.int64]
    radii: list[float]
    loose: npt.NDArray[np.int64]
    loose_geoms: npt.NDArray[np.int64]
    reaches: Array
