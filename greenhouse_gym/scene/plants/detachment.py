"""Detachment of fruit and the suction cup: edits of a running model that swap, weld and park fruit."""

from __future__ import annotations

import mujoco
import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.geom_order import first_world_geom, without_world_geoms
from greenhouse_gym.scene.obstacle_slots import build_tree
from greenhouse_gym.scene.plants.layout import ALL, CUP, LOOSE, SlotIds
from greenhouse_gym.scene.plants.mechanics import GRAVITY, PlantMechanics

_STUB_MASS, _STUB_INERTIA = 1e-3, 1e-6  # kg, kg m^2: pedicel that stays when its fruit has come off
_STUB_DAMPING = 0.02  # N m s/rad
_FRICTION = (0.8, 0.01, 0.003)  # sliding, twisting and rolling, of loose fruit
_SKIN, _HELD_SKIN = (0.02, 1.0), (0.04, 1.0)  # solref of loose and of held fruit: a stiff grip meets soft skin
_GEOM_SHAPE = ("geom_type", "geom_size", "geom_rbound", "geom_aabb", "geom_rgba")


def first_geom(model: mujoco.MjModel, body: int) -> int:
    """Return the first geom of a body: the fruit itself for bodies of fruit."""
    return int(model.body_geomadr[body])


def pull_on(model: mujoco.MjModel, data: mujoco.MjData, bodies: Array) -> Array:
    """Return the pull (n,) beyond the fruit's weight on the pedicels of hanging fruit, N.

    Args:
        model: The model.
        data: Its state after a step and `mujoco.mj_rnePostConstraint`.
        bodies: (n,) bodies of the fruit.
    """
    pull = data.cfrc_int[bodies, 3:]
    pull[:, 2] -= model.body_mass[bodies] * GRAVITY
    return np.asarray(np.sqrt((pull * pull).sum(axis=1)))


def bend_of(model: mujoco.MjModel, data: mujoco.MjData, bodies: Array, axes: Array) -> Array:
    """Return the bend (n,) of the pedicels of hanging fruit, radians.

    Args:
        model: The model.
        data: Its state.
        bodies: (n,) bodies of the fruit.
        axes: (n, 3) unit vectors along the unbent pedicels.
    """
    first = model.jnt_qposadr[model.body_jntadr[bodies]]
    vector = data.qpos[first[:, None] + [1, 2, 3]]  # of the quaternion; what it has along the axis only twists
    across = (vector * vector).sum(axis=1) - (vector * axes).sum(axis=1) ** 2
    return np.asarray(2 * np.arcsin(np.sqrt(np.clip(across, 0.0, 1.0))))


def load_of(pull: Array, bend: Array, mechanics: PlantMechanics) -> Array:
    """Return the load of pedicels as a fraction of their strength; they part at 1."""
    return np.asarray(pull / mechanics.pull_limit + bend / mechanics.bend_limit)


def detach(
    model: mujoco.MjModel, data: mujoco.MjData, scratch: mujoco.MjData, body: int, loose: int, density: float
) -> None:
    """Swap a hanging fruit for a loose one with the same pose and velocity; its pedicel stays.

    Args:
        model: The model.
        data: Its state, with current kinematics.
        scratch: Any data of the model, to compute its constants with.
        body: Body of the fruit.
        loose: Free body that is parked.
        density: Density of fruit, kg/m^3.
    """
    old, new = first_geom(model, body), first_geom(model, loose)
    velocity, quat = np.zeros(6), np.empty(4)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_GEOM, old, velocity, 0)
    mujoco.mju_mat2Quat(quat, data.geom_xmat[old])
    shape_loose(model, old, new)
    model.body_mass[loose], model.body_inertia[loose] = _mass_of(model, old, density)
    model.body_gravcomp[loose] = 0.0
    move_free(model, data, loose, data.geom_xpos[old], quat, velocity)
    data.xpos[loose], data.xquat[loose] = data.geom_xpos[old], quat
    data.geom_xpos[new], data.geom_xmat[new] = data.geom_xpos[old], data.geom_xmat[old]
    leave_stub(model, data, body)
    build_tree(model, loose)
    update_constants(model, scratch)


def move_free(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, position: Array, quat: Array, velocity: Array
) -> None:
    """Move a body with a free joint.

    Args:
        model: The model.
        data: Its state, which is changed.
        body: The body.
        position: (3,) position in the world, metres.
        quat: (4,) orientation in the world, w first.
        velocity: (6,) velocity in the world as ``mj_objectVelocity`` returns it: rotation, rad/s, then motion, m/s.
    """
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    joint = int(model.body_jntadr[body])
    at, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    data.qpos[at : at + 3], data.qpos[at + 3 : at + 7] = position, quat
    data.qvel[dof : dof + 3] = velocity[3:]
    data.qvel[dof + 3 : dof + 6] = matrix.reshape(3, 3).T @ velocity[:3]


def update_constants(model: mujoco.MjModel, scratch: mujoco.MjData) -> None:
    """Compute the constants of a model whose masses or poses changed; welds stay where they are."""
    rules, first = model.eq_data.copy(), first_world_geom(model)
    world = slice(first, first + int(model.body_geomnum[0]))
    with without_world_geoms(model):  # it would compute the tree of the world again, which takes most of the time
        mujoco.mj_setConst(model, scratch)
    model.body_contype[0] = np.bitwise_or.reduce(model.geom_contype[world])
    model.body_conaffinity[0] = np.bitwise_or.reduce(model.geom_conaffinity[world])
    model.eq_data[:] = rules  # it would move the weld of a held fruit to where both bodies are parked


def shape_loose(model: mujoco.MjModel, old: int, new: int) -> None:
    """Give a loose or settled geom the shape of a fruit."""
    for name in _GEOM_SHAPE:
        getattr(model, name)[new] = getattr(model, name)[old]
    model.geom_contype[new], model.geom_conaffinity[new] = LOOSE, ALL
    model.geom_condim[new], model.geom_friction[new] = 6, _FRICTION


def _mass_of(model: mujoco.MjModel, geom: int, density: float) -> tuple[float, Array]:
    """Return mass and principal moments of a fruit's geom, as `greenhouse_gym.scene.plants.mechanics` computes them."""
    size = model.geom_size[geom]
    axes = size if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_ELLIPSOID else np.full(3, size[0])
    mass = 4 / 3 * np.pi * float(axes.prod()) * density
    return mass, mass / 5 * (axes @ axes - axes**2)


def leave_stub(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> None:
    """Leave a hanging body whose shapes have come off, nearly without mass and where it is now."""
    first, count = first_geom(model, body), int(model.body_geomnum[body])
    model.geom_contype[first : first + count] = model.geom_conaffinity[first : first + count] = 0
    model.geom_rgba[first, 3] = 0.0
    joint = int(model.body_jntadr[body])
    numbers = 4 if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL else int(model.body_jntnum[body])
    at, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    model.qpos_spring[at : at + numbers] = data.qpos[at : at + numbers]
    model.dof_damping[dof : dof + min(numbers, 3)] = _STUB_DAMPING
    model.body_mass[body], model.body_inertia[body] = _STUB_MASS, _STUB_INERTIA


def settle(model: mujoco.MjModel, data: mujoco.MjData, loose: int, crate: int, slot: int) -> None:
    """Make a loose fruit that lies still a static part of the scene, and park its body for the next one.

    Args:
        model: The model.
        data: Its state, with current kinematics.
        loose: Body of the fruit.
        crate: Body of the crate, whose last geoms are kept for this.
        slot: Geom among those of the crate.
    """
    old, new = first_geom(model, loose), first_geom(model, crate) + slot
    shape_loose(model, old, new)
    model.geom_contype[new] = 0
    turn = data.xmat[crate].reshape(3, 3)
    model.geom_pos[new] = turn.T @ (data.geom_xpos[old] - data.xpos[crate])
    back, quat = np.empty(4), np.empty(4)
    mujoco.mju_negQuat(back, data.xquat[crate])
    mujoco.mju_mat2Quat(quat, data.geom_xmat[old])
    mujoco.mju_mulQuat(model.geom_quat[new], back, quat)
    model.geom_sameframe[new] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    data.geom_xpos[new], data.geom_xmat[new] = data.geom_xpos[old], data.geom_xmat[old]
    build_tree(model, crate)
    park(model, data, loose)


def park(model: mujoco.MjModel, data: mujoco.MjData, loose: int) -> None:
    """Park a loose body until the next fruit needs it."""
    geom, joint = first_geom(model, loose), int(model.body_jntadr[loose])
    model.geom_contype[geom] = model.geom_conaffinity[geom] = 0
    model.geom_rgba[geom, 3] = 0.0
    at, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    data.qpos[at : at + 7], data.qvel[dof : dof + 6] = model.qpos0[at : at + 7], 0.0
    model.body_gravcomp[loose] = 1.0


def weld(model: mujoco.MjModel, data: mujoco.MjData, ids: SlotIds, body: int) -> None:
    """Hold a fruit by the cup in its present pose."""
    geom = first_geom(model, body)
    hold(model, data, ids, body, geom)
    model.geom_conaffinity[geom] &= ~CUP
    model.geom_priority[geom], model.geom_solref[geom] = 1, _HELD_SKIN


def hold(model: mujoco.MjModel, data: mujoco.MjData, ids: SlotIds, body: int, geom: int) -> None:
    """Hold a body by the tool in its present pose, at the middle of one of its geoms."""
    mat, pos = data.xmat[ids.cup].reshape(3, 3), data.xpos[ids.cup]
    back = np.empty(4)
    mujoco.mju_negQuat(back, data.xquat[ids.cup])
    rule = model.eq_data[ids.weld]
    model.eq_obj1id[ids.weld], model.eq_obj2id[ids.weld] = ids.cup, body
    rule[0:3] = model.geom_pos[geom]
    rule[3:6] = mat.T @ (data.geom_xpos[geom] - pos)
    mujoco.mju_mulQuat(rule[6:10], back, data.xquat[body])
    rule[10] = 1.0
    data.eq_active[ids.weld] = 1


def let_go(model: mujoco.MjModel, data: mujoco.MjData, ids: SlotIds) -> None:
    """Open the weld of the cup."""
    data.eq_active[ids.weld] = 0
    geom = first_geom(model, int(model.eq_obj2id[ids.weld]))
    model.geom_priority[geom], model.geom_solref[geom] = 0, _SKIN
    if model.geom_conaffinity[geom]:
        model.geom_conaffinity[geom] = ALL


def held_force(data: mujoco.MjData, ids: SlotIds) -> Array:
    """Return the force (3,) of a held fruit on the cup in the last step, N, in the scene."""
    rows = np.flatnonzero((data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)) & (data.efc_id == ids.weld))
    return data.efc_force[rows[:3]].copy() if len(rows) else np.zeros(3)
