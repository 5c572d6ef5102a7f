"""Collision checks by compiled kernels, ten times as fast as MuJoCo's, for arms made of capsules and spheres.

Verdicts are those of MuJoCo, except within a micrometre of contact and where MuJoCo misses a thin box. Searches use
them; whatever a search finds is proven by MuJoCo afterwards.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import CollisionChecker
from greenhouse_gym.motion.proof import ProvingChecker
from greenhouse_gym.robots.kinematics import Chain, joint_frames, tool_chain
from greenhouse_gym.robots.robot import TIP_SITE

if TYPE_CHECKING:
    from greenhouse_gym.motion.collision_kernels import World

RANGE = 0.1
"""Largest distance that is measured, metres."""

FINE = 0.02
"""Resolution up to which motions are checked by distances, metres."""

_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_ARM_TYPES = (int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE))
_ARM_FIELDS = (
    "body_parentid", "body_weldid", "body_pos", "body_quat", "body_jntadr", "body_jntnum", "jnt_type", "jnt_pos",
    "jnt_axis", "site_bodyid", "site_pos", "site_quat", "exclude_signature",
)  # fmt: skip
_GEOM_FIELDS = ("bodyid", "type", "pos", "quat", "size", "contype", "conaffinity", "margin")
_NO_MARKS = np.empty(0, dtype=np.bool_)
_CACHE_SIZE = 256  # arms, about 2 MB
_WORLD_TYPES = (*_ARM_TYPES, _PLANE, int(mujoco.mjtGeom.mjGEOM_ELLIPSOID), int(mujoco.mjtGeom.mjGEOM_BOX))


class KernelChecker(CollisionChecker):
    """`CollisionChecker` by compiled kernels; made by `search_checker`."""

    def __init__(self, model: mujoco.MjModel, reaches: Array | None, world: World):
        super().__init__(model, reaches)
        self.world = world

    def are_free(self, configurations: Array) -> npt.NDArray[np.bool_]:
        """Return whether each of some configurations (k, joints) is collision-free, (k,)."""
        self.checks += len(configurations)
        return ~contacts_in(self.world, configurations)

    def motions_are_free(
        self, starts: Array, ends: Array, resolution: float, inside: bool = False
    ) -> npt.NDArray[np.bool_]:
        """Return what `CollisionChecker.motions_are_free` does, by one call of a kernel."""
        from greenhouse_gym.motion.motion_kernel import check_motions

        a, b = (np.array(each, dtype=np.float64, order="C") for each in (starts, ends))
        free = np.empty(len(a), dtype=np.bool_)
        self.checks += check_motions(self.world, self.reaches, resolution, a, b, inside, free)
        return free

    def _all_free(self, configurations: Array, resolution: float = math.inf) -> bool:
        from greenhouse_gym.motion.collision_kernels import FIRST

        if not len(configurations):
            return True
        fine = resolution <= FINE
        count, gaps = _gaps(self.world, configurations, FIRST, RANGE if fine else 0.0, 0.0 if fine else math.inf)
        self.checks += count
        return bool(gaps[count - 1] >= 0.0)


def contacts_in(world: World, configurations: Array) -> npt.NDArray[np.bool_]:
    """Return whether each of some configurations (k, n) is in collision, (k,)."""
    from greenhouse_gym.motion.collision_kernels import CONTACTS

    return _gaps(world, configurations, CONTACTS, 0.0, math.inf)[1] < 0.0


def gaps_in(world: World, configurations: Array, enough: float) -> Array:
    """Return the smallest distances beyond the margins in some configurations (k, n), (k,) metres, up to `RANGE`.

    They are inf where ``enough`` leaves them out, see `greenhouse_gym.motion.collision_kernels.smallest_gaps`.
    """
    from greenhouse_gym.motion.collision_kernels import GAPS

    return _gaps(world, configurations, GAPS, RANGE, enough)[1]


def _gaps(world: World, configurations: Array, wanted: int, largest: float, enough: float) -> tuple[int, Array]:
    """Return the number of configurations decided, and distances; see `collision_kernels.smallest_gaps`."""
    from greenhouse_gym.motion.collision_kernels import smallest_gaps

    gaps = np.empty(len(configurations))
    q = np.ascontiguousarray(configurations, dtype=np.float64)
    return smallest_gaps(world, q, wanted, largest, enough, gaps, _NO_MARKS), gaps


def search_checker(model: mujoco.MjModel, reaches: Array | None = None) -> CollisionChecker:
    """Return the fastest checker for searches on a model; arguments as for `CollisionChecker`."""
    world = kernel_world(model)
    return ProvingChecker(model, reaches) if world is None else KernelChecker(model, reaches, world)


def kernel_world(model: mujoco.MjModel) -> World | None:
    """Return a model as `collision_kernels` wants it, or None if they cannot compute it."""
    colliding = (model.geom_contype | model.geom_conaffinity) > 0
    arm = np.flatnonzero((model.geom_bodyid > 0) & colliding)
    count = int(model.body_geomnum[0])
    tip = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, TIP_SITE)
    simple = np.isin(model.geom_type[arm], _ARM_TYPES).all() and np.isin(model.geom_type[:count], _WORLD_TYPES).all()
    if tip < 0 or not simple or model.npair or model.body_geomadr[0] != 0:
        return None
    own_arm = _arm_of(model, arm, tip)
    if own_arm is None:
        return None
    geoms = np.column_stack(
        [
            model.geom_type[:count], model.geom_pos[:count], _matrices(model.geom_quat[:count]),
            model.geom_size[:count], model.geom_contype[:count], model.geom_conaffinity[:count],
            model.geom_margin[:count],
        ]
    )  # fmt: skip
    planes = geoms[geoms[:, 0] == _PLANE]
    return (*own_arm, geoms, *_wide_tree(model, (model.geom_type == _PLANE) | ~colliding), planes)


def _wide_tree(
    model: mujoco.MjModel, left_out: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
    """Return the tree over the other geoms of the world as `collision_kernels` wants it: boxes and children."""
    from greenhouse_gym.motion.wide_tree_kernel import WIDTH, widen

    first, count = int(model.body_bvhadr[0]), int(model.body_bvhnum[0])
    own, margin = slice(first, first + count), model.geom_margin[: int(model.body_geomnum[0])].max(initial=0.0)
    boxes, children = np.empty((count, 6, WIDTH), np.float32), np.empty((count, WIDTH), np.int32)
    made = widen(
        model.bvh_child[own], model.bvh_nodeid[own], model.bvh_aabb[own], left_out, margin, boxes, children,
    )  # fmt: skip
    return boxes[:made], children[:made]


_Arm = tuple[Array, Array, npt.NDArray[np.int32]]
_arms: dict[bytes, _Arm | None] = {}


def _arm_of(model: mujoco.MjModel, arm: npt.NDArray[np.int64], tip: int) -> _Arm | None:
    """Return the joints, capsules and pairs of a model, or None if a joint does not move the tip.

    Few arms are used with many scenes, so the results are cached by all that they depend on.
    """
    fields = [np.ravel(getattr(model, name)).view(np.uint8) for name in _ARM_FIELDS]
    fields += [np.ravel(getattr(model, f"geom_{name}")[arm]).view(np.uint8) for name in _GEOM_FIELDS]
    key = np.concatenate(fields).tobytes()
    if key not in _arms:
        if len(_arms) >= _CACHE_SIZE:
            _arms.clear()
        chain = tool_chain(model, tip)
        reached = len(chain.axes) == model.njnt == model.nq
        _arms[key] = (chain.table, _capsules(model, chain, arm), _pairs(model, arm)) if reached else None
    return _arms[key]


def _capsules(model: mujoco.MjModel, chain: Chain, arm: npt.NDArray[np.int64]) -> Array:
    """Return the arm's geoms as capsules."""
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    rotations, positions = joint_frames(chain, np.zeros((1, model.nq)))
    result = np.empty((len(arm), 11))
    for row, geom in zip(result, arm.tolist(), strict=True):
        body = int(model.body_weldid[model.geom_bodyid[geom]])
        joint = int(model.body_jntadr[body]) + int(model.body_jntnum[body]) - 1 if body else -1
        long = model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_SPHERE
        half = model.geom_size[geom, 1] * data.geom_xmat[geom].reshape(3, 3)[:, 2] * long
        ends = data.geom_xpos[geom] + np.array([-half, half])
        if joint >= 0:
            ends = (ends - positions[joint, 0]) @ rotations[joint, 0]
        masks = model.geom_contype[geom], model.geom_conaffinity[geom]
        row[:] = joint, *ends.ravel(), model.geom_size[geom, 0], model.geom_margin[geom], *masks
    return result


def _pairs(model: mujoco.MjModel, arm: npt.NDArray[np.int64]) -> npt.NDArray[np.int32]:
    """Return the pairs of the arm's geoms, by their indices in it, that MuJoCo checks against each other."""
    excluded = {(int(pair) >> 16, int(pair) & 0xFFFF) for pair in model.exclude_signature}
    weld, parent = model.body_weldid, model.body_weldid[model.body_parentid]
    found = []
    for i, one in enumerate(arm.tolist()):
        for k, other in enumerate(arm[:i].tolist()):
            a, b = int(model.geom_bodyid[one]), int(model.geom_bodyid[other])
            links = int(weld[a]), int(weld[b])
            adjacent = all(links) and (links[0] == parent[links[1]] or links[1] == parent[links[0]])
            masks = (
                model.geom_contype[one] & model.geom_conaffinity[other]
                or model.geom_contype[other] & model.geom_conaffinity[one]
            )
            if links[0] != links[1] and not adjacent and masks and not {(a, b), (b, a)} & excluded:
                found.append((k, i))
    return np.array(found, dtype=np.int32).reshape(-1, 2)


def _matrices(quats: Array) -> Array:
    """Return rotations (n, 9) by rows of unit quaternions (n, 4)."""
    w, x, y, z = quats.T
    rows = [
        w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z,
    ]  # fmt: skip
    return np.stack(rows, axis=1)
