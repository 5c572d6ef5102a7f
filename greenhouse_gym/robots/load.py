"""Arms from MJCF files, the package's own and others.

A file must contain one chain of hinge and slide joints and nothing else that moves, one position actuator per joint in
the joints' order, a site at the tip (z along the tool) and a key frame with the start. `load_robot` takes the names of
the last two and finds those of MuJoCo Menagerie by itself. A slide joint needs limits; a hinge without limits gets one
turn, half to either side of the start.

It may contain the custom numerics ``velocity_limits`` (rad/s, m/s), ``acceleration_limits`` (rad/s^2, m/s^2) and
``shoulder_height`` (m above the base); a geom ``cup``, the only part that may touch the target (without it, the parts
of the tip's own body may); and sites ``probe_*`` at which the clearance of the arm is observed, with the radius of the
arm there as their size. Collision masks need not be set: every colliding geom collides with everything.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.files import resolved
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError
from greenhouse_gym.geometry import Array, numbers_of
from greenhouse_gym.robots.arm_file import (
    DEFAULT_ACCELERATION,
    DEFAULT_SLIDE_ACCELERATION,
    DEFAULT_SLIDE_SPEED,
    DEFAULT_SPEED,
    attainable_speeds,
    fingerprint,
    joint_limits,
    loading,
    motion_limits,
    numeric,
    read_arm,
    servo_lag,
)
from greenhouse_gym.robots.prepare import PROBE_PREFIX, TIP_SITE, colliding_geoms, prepare_spec, touching_bodies
from greenhouse_gym.robots.robot import Robot
from greenhouse_gym.robots.start import SEARCHES, ahead_of_base, foot_depth

_HERE = Path(__file__).parent
ROBOTS: dict[str, Path] = {path.stem: path for path in sorted(_HERE.glob("*.xml"))}
"""The shipped arms by name, each with its MJCF file."""

FLANGE_SITES = ("flange", "attachment_site", "pinch_site")
"""Names of the flange's site, tried in turn; the last two are MuJoCo Menagerie's."""

TIP_SITES = (TIP_SITE, *FLANGE_SITES[1:])
"""Names of the tip's site, tried in turn."""

START_KEYS = ("ready", "start", "home")
"""Names of the start's key frame, tried in turn; the last is MuJoCo Menagerie's."""

PLANTS_AHEAD = 0.45
"""Distance ahead of an arm's base at which a row's leaves and fruit begin, metres."""


def get_robot(robot: str | Path | Robot) -> Robot:
    """Find an arm by its shipped name or by the path of an MJCF file (read once until it changes).

    Raises:
        UnknownNameError: Neither a shipped name nor an existing file.
        FileFormatError: The file lacks a required part, which the message names.
    """
    if isinstance(robot, Robot):
        return robot
    if str(robot) in ROBOTS:
        path = ROBOTS[str(robot)]
    elif str(robot).endswith(".xml"):
        path = resolved(robot)
    else:
        raise UnknownNameError("robot", str(robot), [*ROBOTS, "(or the path of an MJCF file, ending in .xml)"])
    return _read_once(path, fingerprint(path))


@lru_cache(maxsize=32)
def _read_once(path: Path, fingerprint: str) -> Robot:
    return load_robot(path)


def load_robot(
    path: str | Path,
    tip: str | None = None,
    start: str | npt.ArrayLike | None = None,
    velocity_limits: npt.ArrayLike | None = None,
    acceleration_limits: npt.ArrayLike | None = None,
) -> Robot:
    """Read an arm from any MJCF file.

    Without probe sites, clearance is observed at the joints' anchors (from the second on) and at the tip, with radius
    0. Without a geom ``cup``, the parts of the tip's own body may touch the target.

    Args:
        path: The file, which contains the arm alone, without floor or lights.
        tip: Name of the site at the tip, z along the tool; one of `TIP_SITES` when left out.
        start: Name of a key frame, the joint positions (n,) in radians and metres, or one of `SEARCHES` to search for a
            configuration away from the plants if the file has no key frame of that name: "ready" or "upright". One of
            `START_KEYS` when left out. A warning is given if the arm starts among the plants.
        velocity_limits: (n,) rad/s; when left out, the file's, or `DEFAULT_SPEED` and `DEFAULT_SLIDE_SPEED`, reduced
            to what the servos' force attains against the joints' damping.
        acceleration_limits: (n,) rad/s^2; when left out, the file's, or `DEFAULT_ACCELERATION` and
            `DEFAULT_SLIDE_ACCELERATION`.

    Raises:
        FileFormatError: The file lacks a required part, which the message names.
    """
    path = resolved(path)
    with loading(path):
        return _robot(path, tip, start, velocity_limits, acceleration_limits)


def _robot(
    path: Path,
    tip: str | None,
    start: str | npt.ArrayLike | None,
    velocity_limits: npt.ArrayLike | None,
    acceleration_limits: npt.ArrayLike | None,
) -> Robot:
    bare_spec = read_arm(path)
    bare = bare_spec.compile()
    n = _check_joints(path, bare)
    if not colliding_geoms(bare_spec):
        raise FileFormatError(path, "none of its geoms collides: give the links geoms with contype and conaffinity")
    tip = find_name(path, "site", tip, TIP_SITES, [bare.site(i).name for i in range(bare.nsite)])
    if bare.body_weldid[bare.site(tip).bodyid[0]] == 0:
        raise FileFormatError(path, f"no joint moves the site {tip!r}: the tip belongs on the last link")
    own_probes = any(bare.site(i).name.startswith(PROBE_PREFIX) for i in range(bare.nsite))
    search = SEARCHES.get(start) if isinstance(start, str) and start not in _keys(bare) else None
    begin = np.zeros(n) if search else _start(path, bare, start)
    lower, upper = joint_limits(bare, begin)
    spec = prepare_spec(bare_spec, tip)
    if search:
        begin = search(spec, lower, upper, foot_depth(spec.compile()))
    model = spec.compile()
    _check_start(path, model, begin, lower, upper)
    if not search and (ahead := ahead_of_base(model, begin)) > PLANTS_AHEAD:
        warnings.warn(
            f"{path}: at its start the arm reaches {ahead:.2f} m ahead of its base, but plants stand from about "
            f'{PLANTS_AHEAD} m on; load_robot(..., start="ready") finds a collision-free start',
            stacklevel=3,
        )
    height = numeric(path, model, "shoulder_height", 1)
    probes = [i for i in range(model.nsite) if model.site(i).name.startswith(PROBE_PREFIX)]
    radii = model.site_size[probes, 0].copy()
    sliding = np.asarray(model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE)
    speeds = np.minimum(np.where(sliding, DEFAULT_SLIDE_SPEED, DEFAULT_SPEED), attainable_speeds(model))
    accelerations = np.where(sliding, DEFAULT_SLIDE_ACCELERATION, DEFAULT_ACCELERATION)
    return Robot(
        name=path.stem,
        path=path,
        joints=tuple(model.joint(i).name for i in range(n)),
        start=begin,
        starts=MappingProxyType({model.key(i).name: model.key_qpos[i].copy() for i in range(model.nkey)}),
        lower=lower,
        upper=upper,
        velocity_limits=motion_limits(path, model, "velocity_limits", velocity_limits, speeds),
        acceleration_limits=motion_limits(path, model, "acceleration_limits", acceleration_limits, accelerations),
        shoulder_height=_shoulder_height(model, begin) if height is None else float(height[0]),
        probes=tuple(model.site(i).name for i in probes),
        probe_radii=radii if own_probes else np.zeros_like(radii),
        specification=spec,
        tip=tip,
        sliding=sliding,
        lag=servo_lag(model),
        foot=foot_depth(model),
    )


def find_name(path: Path, kind: str, name: str | None, usual: Sequence[str], present: Sequence[str]) -> str:
    """Find a name, or by default the first of the usual names, among those in a file.

    Raises:
        FileFormatError: The file has none of them; the message lists those it has.
    """
    names = usual if name is None else (name,)
    for candidate in names:
        if candidate in present:
            return candidate
    raise FileFormatError(
        path, f"the arm has no {kind} named {' or '.join(map(repr, names))}; it has {', '.join(present) or 'none'}"
    )


def _check_joints(path: Path, model: mujoco.MjModel) -> int:
    n = int(model.njnt)
    if n == 0 or not np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)).all():
        raise FileFormatError(path, "an arm needs hinge or slide joints and no other type")
    for i in range(n):
        if not model.jnt_limited[i] and model.jnt_type[i] == mujoco.mjtJoint.mjJNT_SLIDE:
            raise FileFormatError(path, f"slide joint {model.joint(i).name!r} has no limits: give it a range")
    if model.nu != n:
        raise FileFormatError(path, f"{n} joints, {model.nu} actuators; expected one position actuator each")
    for i in range(n):
        drives = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_trnid[i, 0] == i
        servo = model.actuator_gainprm[i, 0] > 0 and model.actuator_biasprm[i, 1] == -model.actuator_gainprm[i, 0]
        if not (drives and servo):
            raise FileFormatError(
                path, f"actuator {i} must be a position actuator of joint {model.joint(i).name!r}, in the joints' order"
            )
    return n


def _check_start(path: Path, model: mujoco.MjModel, start: Array, lower: Array, upper: Array) -> None:
    if ((start < lower) | (start > upper)).any():
        raise FileFormatError(path, f"its start {start.tolist()} is outside the joint limits")
    touching = touching_bodies(model, start.tolist())
    if touching:
        names = ", ".join(f"{model.body(a).name!r} and {model.body(b).name!r}" for a, b in touching)
        raise FileFormatError(
            path, f"at its start it touches itself, or nearly: {names}; exclude the pair or give another start"
        )


def _keys(model: mujoco.MjModel) -> list[str]:
    return [model.key(i).name for i in range(model.nkey)]


def _start(path: Path, model: mujoco.MjModel, start: str | npt.ArrayLike | None) -> Array:
    if start is None or isinstance(start, str):
        return np.array(model.key_qpos[model.key(find_name(path, "key frame", start, START_KEYS, _keys(model))).id])
    q = numbers_of(start)
    if q.shape != (model.njnt,) or not np.isfinite(q).all():
        raise InvalidValueError(f"start must be {model.njnt} finite joint positions, got {start!r}")
    return q


def _shoulder_height(model: mujoco.MjModel, start: Array) -> float:
    """Return the height above the base of the first joint that lifts the arm; of the first joint if none does."""
    data = mujoco.MjData(model)
    data.qpos[:] = start
    mujoco.mj_kinematics(model, data)
    hinge = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    lifting = np.flatnonzero(hinge & (np.abs(data.xaxis[:, 2]) < 0.5))
    joint = lifting[0] if len(lifting) else 0
    return float(data.xanchor[joint, 2] - data.xpos[1, 2])
