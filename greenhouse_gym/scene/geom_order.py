"""Which geoms MuJoCo goes through in every physics step of a moving arm, and how to make them few.

What touches what is found through trees over the geoms. But before that, the broad phase asks every geom of a model,
twice, whether it is the world's, and for each pair of bodies all their geoms what they may touch. Among the thousands
of boxes of a true row that takes most of the time. So the models that are stepped have the arm's geoms first
(`put_arm_first`), and while they are stepped they tell of these and of a few of the world's only (`ShortLists`). The
numbers that come out are the same, bit for bit.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import mujoco
import numpy as np
import numpy.typing as npt

_LISTED = 2
"""How many geoms of the world are listed at least.

The first ones, with the floor among them, may touch whatever any of them may. Two bodies of one geom each would be
tested without their trees.
"""


def world_begins(model: mujoco.MjModel) -> int:
    """Id of the first geom of the world: 0, or the number of the arm's geoms where they come first."""
    return int(model.body_geomadr[0])


def put_arm_first(model: mujoco.MjModel) -> None:
    """Move the geoms of the world behind all others, in place; names of geoms are not to be asked for any more.

    A model in which more than bodies and trees tells of geoms by their ids stays as it is, and is stepped more slowly.
    """
    if model.npair or model.nwrap or model.nskin or (model.sensor_objtype == mujoco.mjtObj.mjOBJ_GEOM).any():
        return
    count, world = model.ngeom, int(model.body_geomnum[0])
    for name in dir(model):
        if name.startswith("geom_"):
            table = getattr(model, name)
            table[:] = np.roll(table, -world, axis=0)
    has_geoms = model.body_geomnum > 0
    model.body_geomadr[has_geoms] = (model.body_geomadr[has_geoms] - world) % count
    for first, nodes in zip(model.body_bvhadr, model.body_bvhnum, strict=True):
        ids = model.bvh_nodeid[first : first + nodes]
        ids[ids >= 0] = (ids[ids >= 0] - world) % count


def id_in_compiled(model: mujoco.MjModel, geom: int) -> int:
    """Id that a geom has in the compiled model, of which this one is a copy in either order."""
    return int((geom - world_begins(model)) % model.ngeom)


class ShortLists:
    """Models that tell of few geoms within a ``with`` block.

    Only there: whoever places the geoms or renders them has to know of all.

    Args:
        models: Models of one layout.
    """

    def __init__(self, models: Sequence[mujoco.MjModel]):
        first = models[0]
        self._of_world = [model.body_geomnum for model in models]
        self._world = world = int(self._of_world[0][0])
        begins, self._all = world_begins(first), first.ngeom
        own = slice(begins, begins + world)
        masks = np.stack([first.geom_contype[own], first.geom_conaffinity[own]])
        told = np.bitwise_or.accumulate(masks, axis=1)
        enough = int((told == told[:, -1:]).all(axis=0).argmax()) + 1
        self._few = min(max(enough, _LISTED), world)
        counts = [_geom_count(model) for model in models] if begins else []
        self._counts = [count for count in counts if count is not None]
        self._moving = begins

    def __enter__(self) -> None:
        for of_world in self._of_world:
            of_world[0] = self._few
        for count in self._counts:
            count[0] = self._moving

    def __exit__(self, *error: object) -> None:
        for of_world in self._of_world:
            of_world[0] = self._world
        for count in self._counts:
            count[0] = self._all


def _geom_count(model: mujoco.MjModel) -> npt.NDArray[np.int64] | None:
    """(1,) a model's number of geoms, live: the bindings show it, but do not let it be set.

    A model in memory begins with its sizes. None where they are not found there as the bindings tell them, as may be
    in another version of MuJoCo, which then goes through all geoms.
    """
    names = list(getattr(model, "_size_fields", ()))
    if "ngeom" not in names:
        return None
    sizes = np.ctypeslib.as_array((ctypes.c_int64 * len(names)).from_address(model._address))
    if sizes.tolist() != [getattr(model, name) for name in names]:
        return None
    at = names.index("ngeom")
    return sizes[at : at + 1]
