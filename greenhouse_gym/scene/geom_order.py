"""Order the geoms of a model so that MuJoCo's broad phase visits few of them in each physics step of a moving arm.

MuJoCo finds contacts through trees over the geoms. Before that, its broad phase asks each geom of a model twice whether
it belongs to the world, and compares the collision masks of all geoms of each pair of bodies. With the thousands of
boxes of a true row, this takes most of the time. Models that are stepped therefore have the arm's geoms first
(`put_arm_first`), and during a step they list only these and a few of the world's (`ShortGeomLists`). Results stay
equal bit for bit.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache

import mujoco
import numpy as np
import numpy.typing as npt

_MIN_LISTED = 2
"""Minimum number of geoms of the world that are listed: MuJoCo tests two bodies of one geom each without trees."""

_THREE_GEOMS = "<mujoco><worldbody>" + 3 * "<geom size='1'/>" + "</worldbody></mujoco>"


def first_world_geom(model: mujoco.MjModel) -> int:
    """Return the id of the first geom of the world: 0, or the number of the arm's geoms if they come first."""
    return int(model.body_geomadr[0])


def put_arm_first(model: mujoco.MjModel) -> None:
    """Move the geoms of the world behind all others, in place; the names of geoms are wrong afterwards.

    A model whose pairs, tendons, skins or sensors refer to geoms stays unchanged, and is stepped more slowly.
    """
    if model.npair or model.nwrap or model.nskin or (model.sensor_objtype == mujoco.mjtObj.mjOBJ_GEOM).any():
        return
    _move_geoms(model, int(model.body_geomnum[0]))


def put_world_first(model: mujoco.MjModel) -> None:
    """Undo `put_arm_first`."""
    _move_geoms(model, first_world_geom(model))


def _move_geoms(model: mujoco.MjModel, world: int) -> None:
    """Move the first ``world`` geoms of a model behind all others."""
    count = model.ngeom
    for name in _names("geom_"):
        table = getattr(model, name)
        table[:] = np.roll(table, -world, axis=0)
    has_geoms = model.body_geomnum > 0
    model.body_geomadr[has_geoms] = (model.body_geomadr[has_geoms] - world) % count
    for first, nodes in zip(model.body_bvhadr, model.body_bvhnum, strict=True):
        ids = model.bvh_nodeid[first : first + nodes]
        ids[ids >= 0] = (ids[ids >= 0] - world) % count


def copy_bodies(source: mujoco.MjModel, model: mujoco.MjModel) -> None:
    """Copy bodies, joints, constraints and all geoms but the world's from one model into another of the same layout.

    Args:
        source: Its geoms in the compiled order.
        model: Its geoms in either order.
    """
    world, first, count = int(source.body_geomnum[0]), first_world_geom(model), source.ngeom
    for name in _names("body_", "jnt_", "dof_", "eq_", "qpos"):
        if name != "body_geomadr":
            getattr(model, name)[:] = getattr(source, name)
    ends = source.body_bvhadr + source.body_bvhnum
    nodes = slice(int(ends[0]), int(ends.max()))
    for name in _names("bvh_"):
        getattr(model, name)[nodes] = getattr(source, name)[nodes]
    ids = model.bvh_nodeid[nodes]
    ids[ids >= 0] -= world if first else 0
    moving = slice(0, first) if first else slice(world, count)
    for name in _names("geom_"):
        getattr(model, name)[moving] = getattr(source, name)[world:]


@cache
def _names(*beginnings: str) -> list[str]:
    return [name for name in dir(mujoco.MjModel) if name.startswith(beginnings)]


def compiled_geom_id(model: mujoco.MjModel, geom: int) -> int:
    """Return the id of a geom in the compiled model, from which this model was copied and maybe reordered."""
    return int((geom - first_world_geom(model)) % model.ngeom)


class ShortGeomLists:
    """Lists of the geoms of n models, made short for a while.

    As a context, it lists few geoms of all models. Only stepping may happen inside: code that places or renders geoms
    needs all of them.

    Args:
        models: Models of the same layout.
    """

    def __init__(self, models: Sequence[mujoco.MjModel]):
        first = models[0]
        self._world_counts = [model.body_geomnum for model in models]
        self._world = world = int(self._world_counts[0][0])
        start, self._all = first_world_geom(first), first.ngeom
        own = slice(start, start + world)
        enough = max(_with_all_bits(masks[own]) for masks in (first.geom_contype, first.geom_conaffinity))
        self._listed = min(max(enough, _MIN_LISTED), world)
        counts = [_geom_count(model) for model in models] if start else []
        self._counts = [count for count in counts if count is not None]
        self._moving = start
        self._used = [world] * len(models)

    def load(self, i: int, used: int) -> None:
        """Take note of how many geoms of the world of a model come before the parked ones."""
        self._used[i] = used

    def load_all(self, other: ShortGeomLists) -> None:
        """Take note of what another object knows of as many models."""
        self._used = list(other._used)

    def __enter__(self) -> None:
        for world_count in self._world_counts:
            world_count[0] = self._listed
        for count in self._counts:
            count[0] = self._moving

    def __exit__(self, *error: object) -> None:
        for world_count in self._world_counts:
            world_count[0] = self._world
        for count in self._counts:
            count[0] = self._all

    @contextmanager
    def short(self, i: int) -> Iterator[None]:
        """Context in which one model lists few geoms."""
        self._set(i, self._listed, self._moving)
        try:
            yield
        finally:
            self._set(i, self._world, self._all)

    @contextmanager
    def unparked(self, ids: Sequence[int]) -> Iterator[None]:
        """Context in which some models list no geoms that are parked; it may place geoms."""
        for i in ids:
            self._set(i, self._used[i], self._moving + self._used[i])
        try:
            yield
        finally:
            for i in ids:
                self._set(i, self._world, self._all)

    def _set(self, i: int, world: int, total: int) -> None:
        """List so many geoms of the world and in total."""
        self._world_counts[i][0] = world
        if self._counts:
            self._counts[i][0] = total


def _with_all_bits(masks: npt.NDArray[np.int32]) -> int:
    """Return the number of masks (n,) from the first on that together have the bits of all."""
    everything = int(np.bitwise_or.reduce(masks))
    bits = [1 << k for k in range(everything.bit_length()) if everything >> k & 1]
    return max((int((masks & bit > 0).argmax()) + 1 for bit in bits), default=1)


@contextmanager
def without_world_geoms(model: mujoco.MjModel) -> Iterator[None]:
    """Context in which a model has no geoms of the world, for what depends on bodies alone; they have to come last."""
    moving = first_world_geom(model)
    count = _geom_count(model) if moving else None
    counts = [] if count is None else [model.body_geomnum[:1], model.body_bvhnum[:1], count]
    before = [int(one[0]) for one in counts]
    for one, value in zip(counts, (0, 0, moving), strict=False):
        one[0] = value
    try:
        yield
    finally:
        for one, value in zip(counts, before, strict=True):
            one[0] = value


def _geom_count(model: mujoco.MjModel) -> npt.NDArray[np.int64] | None:
    """Return a writable view (1,) of a model's number of geoms, which the bindings make read-only.

    The result is None if the bindings show no place for it, as may happen in another version of MuJoCo, which then
    visits all geoms.
    """
    index = _geom_count_index()
    if index is None:
        return None
    return np.ctypeslib.as_array((ctypes.c_int64 * 1).from_address(model._address + 8 * index))


@cache
def _geom_count_index() -> int | None:
    return index_of_geom_count(mujoco.MjModel.from_xml_string(_THREE_GEOMS))


def index_of_geom_count(model: mujoco.MjModel) -> int | None:
    """Return the index of the number of geoms among the sizes that a model in memory begins with.

    If the sizes do not agree with the bindings, the result is None.
    """
    names = list(getattr(model, "_size_fields", ()))
    if "ngeom" not in names:
        return None
    sizes = (ctypes.c_int64 * len(names)).from_address(model._address)
    return names.index("ngeom") if list(sizes) == [getattr(model, name) for name in names] else None
