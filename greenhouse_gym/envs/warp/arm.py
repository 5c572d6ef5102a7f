"""An arm as arrays: a chain of links whose parts are capsules, for kernels that know nothing of MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.actions import ActionRule, max_command_error
from greenhouse_gym.envs.state import ControlTiming
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import CompiledScene
from greenhouse_gym.scene.mjcf import ARM_AND_CUP, ARM_ONLY, TIMESTEP

Ints = npt.NDArray[np.int32]

_INSTEAD = 'choose backend="mujoco"'


@dataclass(frozen=True, eq=False)
class ArmArrays:
    """Arm with n joints, g colliding parts and k probe points; SI units.

    Link i moves with joint i. Its frame has its origin at the joint's anchor. The base is link -1.

    Attributes:
        position: (n, 3) origin of each link's frame in the frame of the link before.
        rotation: (n, 3, 3) its rotation there, at joint position 0.
        axis: (n, 3) joint axis in the link's frame.
        mass: (n,) mass of the link.
        center: (n, 3) its center of mass, in its frame.
        inertia: (n, 3, 3) its inertia about that center, in its frame.
        armature: (n,) inertia of the joint's motor.
        stiffness: (n,) of the servo.
        damping: (n,) of the servo and the joint.
        range_low: (n,) joint position below which the physics push back.
        range_high: (n,) joint position above which they do.
        limit_stiffness: (n,) acceleration per depth beyond the range.
        limit_damping: (n,) acceleration per velocity there.
        limit_weight: (n,) inverse inertia by which MuJoCo softens the limit.
        impedance: (n, 5) MuJoCo's ``solimp`` of the limit.
        lower: (n,) lower position limit of commands.
        upper: (n,) upper position limit.
        peak: (size,) change of the commands by an action of 1; of the tip for tip velocities.
        max_change: (n,) change of a command at the speed limit.
        part_link: (g,) link of each part, ascending.
        part_start: (g, 3) start of the part's axis in the frame of its link.
        part_end: (g, 3) end of that axis.
        part_radius: (g,) radius.
        part_mask: (g,) 0 if the part passes through the world, 1 if it may touch all of it, 2 all but the target.
        pairs: (p, 2) parts that may touch each other.
        probe_link: (k,) link of each probe point, ascending.
        probe_position: (k, 3) in the frame of its link.
        probe_radius: (k,) radius of the arm there.
        tip_position: (3,) in the frame of the last link.
        tip_axis: (3,) axis of the tool in that frame.
        timestep: Time of a physics step.
        max_error: Maximum distance of a command from the measured joint.
    """

    position: Array
    rotation: Array
    axis: Array
    mass: Array
    center: Array
    inertia: Array
    armature: Array
    stiffness: Array
    damping: Array
    range_low: Array
    range_high: Array
    limit_stiffness: Array
    limit_damping: Array
    limit_weight: Array
    impedance: Array
    lower: Array
    upper: Array
    peak: Array
    max_change: Array
    part_link: Ints
    part_start: Array
    part_end: Array
    part_radius: Array
    part_mask: Ints
    pairs: Ints
    probe_link: Ints
    probe_position: Array
    probe_radius: Array
    tip_position: Array
    tip_axis: Array
    timestep: float
    max_error: float


class _Chain:
    """Poses of the bodies of a model in the frames of the links that carry them."""

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        self._joint_of = {int(body): i for i, body in enumerate(model.jnt_bodyid)}

    def __call__(self, body: int) -> tuple[int, Array, Array]:
        """Return the link of a body, and the rotation and position of the body in the link's frame."""
        model, rotation, position = self._model, np.eye(3), np.zeros(3)
        while body not in self._joint_of and int(model.body_parentid[body]):
            turn = matrix(model.body_quat[body])
            rotation, position = turn @ rotation, model.body_pos[body] + turn @ position
            body = int(model.body_parentid[body])
        link = self._joint_of.get(body, -1)
        return link, rotation, position - (model.jnt_pos[link] if link >= 0 else 0.0)

    def point(self, body: int, local: Array) -> tuple[int, Array]:
        """Return the link of a point of a body and its position in the link's frame."""
        link, rotation, position = self(body)
        return link, position + rotation @ local


def matrix(quaternion: Array) -> Array:
    """Return the rotation (3, 3) of a quaternion (4,)."""
    result = np.empty(9)
    mujoco.mju_quat2Mat(result, np.asarray(quaternion, dtype=np.float64))
    return result.reshape(3, 3)


def colliding_parts(model: mujoco.MjModel) -> npt.NDArray[np.int64]:
    """Return the ids (g,) of the geoms of an arm that collide, from base to tip."""
    masks = model.geom_contype | model.geom_conaffinity
    geoms = np.flatnonzero((model.geom_bodyid > 0) & (masks > 0))
    chain = _Chain(model)
    links = [chain(int(model.geom_bodyid[geom]))[0] for geom in geoms]
    return np.asarray(geoms[np.argsort(links, kind="stable")])


def arm_arrays(compiled: CompiledScene, rule: ActionRule, timing: ControlTiming) -> ArmArrays:
    """Return the arm of a compiled scene.

    Args:
        compiled: Any scene with the arm.
        rule: The kind of action.
        timing: Timing of actions.

    Raises:
        InvalidValueError: The kernels cannot simulate the arm.
    """
    model, robot = compiled.model, compiled.robot
    check_arm(robot, model)
    chain, parts = _Chain(model), colliding_parts(model)
    ends = [_ends(model, chain, int(geom)) for geom in parts]
    probes = [chain.point(int(model.site_bodyid[site]), model.site_pos[site]) for site in compiled.probe_sites]
    order = sorted(range(len(probes)), key=lambda k: probes[k][0])
    if order != list(range(len(probes))):
        raise InvalidValueError(f"robot {robot.name!r}: probe points must be in order from base to tip; {_INSTEAD}")
    tip = compiled.tip_site
    tip_body = int(model.site_bodyid[tip])
    return ArmArrays(
        **_links(model, chain),
        **_limits(model),
        axis=model.jnt_axis.copy(),
        armature=model.dof_armature.copy(),
        stiffness=model.actuator_gainprm[:, 0].copy(),
        damping=model.dof_damping - model.actuator_biasprm[:, 2],
        lower=robot.lower,
        upper=robot.upper,
        peak=np.asarray(getattr(rule, "peak", getattr(rule, "scale", None)), dtype=np.float64),
        max_change=robot.velocity_limits * timing.interval,
        part_link=np.array([link for link, *_ in ends], dtype=np.int32),
        part_start=np.array([start for _, start, _ in ends]),
        part_end=np.array([end for *_, end in ends]),
        part_radius=model.geom_size[parts, 0],
        part_mask=np.array(
            [
                0 if link < 0 or not _collide(model, geom, ARM_AND_CUP) else 1 if _collide(model, geom, ARM_ONLY) else 2
                for (link, *_), geom in zip(ends, parts.tolist(), strict=True)
            ],
            dtype=np.int32,
        ),
        pairs=_pairs(model, parts),
        probe_link=np.array([link for link, _ in probes], dtype=np.int32),
        probe_position=np.array([position for _, position in probes]),
        probe_radius=robot.probe_radii,
        tip_position=chain.point(tip_body, model.site_pos[tip])[1],
        tip_axis=(chain(tip_body)[1] @ matrix(model.site_quat[tip]))[:, 2],
        timestep=TIMESTEP,
        max_error=max_command_error(robot, timing),
    )


def check_arm(robot: Robot, model: mujoco.MjModel) -> None:
    """Raise an error for an arm that the kernels cannot simulate.

    Raises:
        InvalidValueError: The message names what they lack, and the way out.
    """
    parts = colliding_parts(model)
    round_ones = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_SPHERE))
    other = [model.geom(int(geom)).name for geom in parts if model.geom_type[geom] not in round_ones]
    lacks = {
        "sliding joints": robot.sliding.any(),
        "several joints on one body": len(set(model.jnt_bodyid.tolist())) < model.njnt,
        "branches": any(_Chain(model)(int(model.body_parentid[b]))[0] != i - 1 for i, b in enumerate(model.jnt_bodyid)),
        "servos with force limits": model.actuator_forcelimited.any() or model.jnt_actfrclimited.any(),
        "joint limits with solref below 0": (model.jnt_solref <= 0).any(),
        "joints with springs": model.jnt_stiffness.any(),
        "joints with dry friction": model.dof_frictionloss.any(),
        f"parts that are not capsules or spheres ({', '.join(other)})": bool(other),
    }
    for what, found in lacks.items():
        if found:
            raise InvalidValueError(
                f'backend="warp" cannot simulate {what}, which robot {robot.name!r} has; {_INSTEAD}'
            )


def _links(model: mujoco.MjModel, chain: _Chain) -> dict[str, Array]:
    """Return poses, masses, centers of mass and inertias of the links, by field of `ArmArrays`."""
    n = model.njnt
    position, rotation = np.zeros((n, 3)), np.zeros((n, 3, 3))
    for i, body in enumerate(model.jnt_bodyid.tolist()):
        _, turn, origin = chain(int(model.body_parentid[body]))
        own = matrix(model.body_quat[body])
        position[i] = origin + turn @ (model.body_pos[body] + own @ model.jnt_pos[i])
        rotation[i] = turn @ own
    pieces: list[list[tuple[float, Array, Array]]] = [[] for _ in range(n)]
    for body in range(1, model.nbody):
        link, turn, _ = chain(body)
        if link >= 0:
            axes = turn @ matrix(model.body_iquat[body])
            inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
            pieces[link].append((float(model.body_mass[body]), chain.point(body, model.body_ipos[body])[1], inertia))
    mass, center, inertia = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3, 3))
    for i, own_pieces in enumerate(pieces):
        mass[i] = sum(piece[0] for piece in own_pieces)
        center[i] = sum(m * c for m, c, _ in own_pieces) / mass[i]
        for m, c, about in own_pieces:
            offset = c - center[i]
            inertia[i] += about + m * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return {"position": position, "rotation": rotation, "mass": mass, "center": center, "inertia": inertia}


def _limits(model: mujoco.MjModel) -> dict[str, Array]:
    """Return the soft joint limits, by field of `ArmArrays` (MuJoCo's documentation, solver parameters)."""
    limited, impedance = model.jnt_limited.astype(bool), model.jnt_solimp.copy()
    time = np.maximum(model.jnt_solref[:, 0], 2 * TIMESTEP)
    strongest, ratio = impedance[:, 1], model.jnt_solref[:, 1]
    return {
        "range_low": np.where(limited, model.jnt_range[:, 0], -np.inf),
        "range_high": np.where(limited, model.jnt_range[:, 1], np.inf),
        "limit_stiffness": 1 / (strongest * time * ratio) ** 2,
        "limit_damping": 2 / (strongest * time),
        "limit_weight": model.dof_invweight0.copy(),
        "impedance": impedance,
    }


def _ends(model: mujoco.MjModel, chain: _Chain, geom: int) -> tuple[int, Array, Array]:
    """Return the link of a capsule or sphere and the ends of its axis in the link's frame."""
    body = int(model.geom_bodyid[geom])
    link, turn, _ = chain(body)
    _, center = chain.point(body, model.geom_pos[geom])
    is_capsule = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE
    half = turn @ matrix(model.geom_quat[geom])[:, 2] * (model.geom_size[geom, 1] if is_capsule else 0.0)
    return link, center - half, center + half


def _collide(model: mujoco.MjModel, geom: int, mask: int) -> bool:
    return bool((model.geom_contype[geom] | model.geom_conaffinity[geom]) & mask)


def _pairs(model: mujoco.MjModel, parts: npt.NDArray[np.int64]) -> Ints:
    """Return the indices (p, 2) of the parts that MuJoCo tests against each other."""
    excluded = {(int(pair) >> 16, int(pair) & 0xFFFF) for pair in model.exclude_signature}
    weld, parent = model.body_weldid, model.body_parentid
    result = []
    for i, a in enumerate(parts.tolist()):
        for j, b in enumerate(parts[i + 1 :].tolist(), i + 1):
            bodies = sorted((int(model.geom_bodyid[a]), int(model.geom_bodyid[b])))
            first, second = (int(weld[body]) for body in bodies)
            neighbors = first and second and (weld[parent[first]] == second or weld[parent[second]] == first)
            masks = (model.geom_contype[a] & model.geom_conaffinity[b]) | (
                model.geom_contype[b] & model.geom_conaffinity[a]
            )
            listed = (bodies[0], bodies[1]) in excluded or (bodies[1], bodies[0]) in excluded
            if first != second and not neighbors and not listed and masks:
                result.append((i, j))
    return np.array(result, dtype=np.int32).reshape(-1, 2)


def unsupported(what: str, value: Any, choices: str) -> InvalidValueError:
    """Return the error for a setting that the kernels do not support."""
    return InvalidValueError(f'backend="warp" does not support {what}={value!r}: choose {choices}, or backend="mujoco"')
