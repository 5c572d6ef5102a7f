"""A robot arm: an MJCF file that carries its own start, limits, tip and probe points, and the record read from it.

What the file must hold: one chain of hinge joints with limits and nothing else that moves, one position actuator per
joint in the joints' order, a site at the tip (z along the tool) and a key frame with the start. `load_robot` takes the
names of the last two; MuJoCo Menagerie's are found by themselves.

What it may hold: the custom numerics ``velocity_limits`` (rad/s), ``acceleration_limits`` (rad/s^2) and
``shoulder_height`` (m above the base); a geom ``cup``, the only part that may touch the target; and sites ``probe_*``
at which the clearance of the arm is observed, with the radius of the arm there as their size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError, require_choice
from greenhouse_gym.geometry import Array

_HERE = Path(__file__).parent
ROBOTS: dict[str, Path] = {path.stem: path for path in sorted(_HERE.glob("*.xml"))}
"""The shipped arms by name, each with its MJCF file."""

TIP_SITE, CUP_GEOM, PROBE_PREFIX = "tip", "cup", "probe_"

TIP_SITES = (TIP_SITE, "attachment_site")
"""Names of the tip's site that are tried in turn; the last is MuJoCo Menagerie's."""

START_KEYS = ("start", "home")
"""Names of the start's key frame that are tried in turn; the last is MuJoCo Menagerie's."""

DEFAULT_SPEED = 1.6
"""Speed limit of joints whose file names none, rad/s: what a joint action of 1 asks for."""

DEFAULT_ACCELERATION = 10.0
"""Acceleration limit of joints whose file names none, rad/s^2."""


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot arm.

    Attributes:
        name: Short name, the stem of its file.
        path: The MJCF file.
        joints: Names of the n joints, in order.
        start: (n,) configuration an episode starts from, radians.
        starts: All key frames of the file by name, (n,) radians each: what else an episode may start from. The shipped
            arms have ``start``, upright, and ``folded``, tucked away over the aisle.
        lower: (n,) lower joint limits, radians.
        upper: (n,) upper joint limits, radians.
        velocity_limits: (n,) rad/s.
        acceleration_limits: (n,) rad/s^2.
        shoulder_height: Height of the shoulder above the base, metres.
        probes: Names of the k sites at which clearance is observed.
        probe_radii: (k,) radius of the arm at those sites, metres.
        tip: Name of the tip's site in the file; `spec` calls it ``tip``.
    """

    name: str
    path: Path
    joints: tuple[str, ...]
    start: Array
    starts: Mapping[str, Array]
    lower: Array
    upper: Array
    velocity_limits: Array
    acceleration_limits: Array
    shoulder_height: float
    probes: tuple[str, ...]
    probe_radii: Array
    tip: str = TIP_SITE

    def configuration(self, start: str | npt.ArrayLike | None) -> npt.ArrayLike:
        """A start by its name in ``starts``; None is the arm's own, and anything else is given back as it is.

        Raises:
            UnknownNameError: No key frame of that name.
        """
        if start is None:
            return self.start
        return self.starts[require_choice("start", start, self.starts)] if isinstance(start, str) else start

    def spec(self) -> mujoco.MjSpec:
        """A fresh, editable MuJoCo specification of the arm alone."""
        return _prepare(mujoco.MjSpec.from_file(str(self.path)), self.tip)


def get_robot(robot: str | Path | Robot) -> Robot:
    """Find an arm by its shipped name or by the path of an MJCF file (as `load_robot` does, read once per process).

    Raises:
        UnknownNameError: Neither a shipped name nor an existing file.
        FileFormatError: The file lacks something an arm needs; the message says what.
    """
    if isinstance(robot, Robot):
        return robot
    if str(robot) in ROBOTS:
        return _read_once(ROBOTS[str(robot)])
    if str(robot).endswith(".xml"):
        return _read_once(Path(robot).resolve())
    raise UnknownNameError("robot", str(robot), [*ROBOTS, "(or the path of an MJCF file, ending in .xml)"])


@cache
def _read_once(path: Path) -> Robot:
    return load_robot(path)


def load_robot(
    path: str | Path,
    tip: str | None = None,
    start: str | npt.ArrayLike | None = None,
    velocity_limits: npt.ArrayLike | None = None,
    acceleration_limits: npt.ArrayLike | None = None,
) -> Robot:
    """Read an arm from an MJCF file that may know nothing of this package.

    Without probe sites, clearance is observed at the joints' anchors (from the second on) and at the tip, with radius
    0. Without a geom ``cup``, nothing of the arm may touch the target.

    Args:
        path: The file: the arm alone, without floor or lights in its world.
        tip: Name of the site at the tip, z along the tool; one of `TIP_SITES` when left out.
        start: Name of a key frame, or the joint angles (n,) in radians; one of `START_KEYS` when left out.
        velocity_limits: (n,) rad/s; when left out, the file's, or `DEFAULT_SPEED`.
        acceleration_limits: (n,) rad/s^2; when left out, the file's, or `DEFAULT_ACCELERATION`.

    Raises:
        FileFormatError: The file lacks something an arm needs; the message says what.
    """
    path = Path(path).resolve()
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        bare = spec.compile()
    except (ValueError, OSError) as error:
        raise FileFormatError(path, f"MuJoCo cannot load it: {error}") from error
    n = _check_joints(path, bare)
    tip = _choose(path, "site", tip, TIP_SITES, [bare.site(i).name for i in range(bare.nsite)])
    model = _prepare(spec, tip).compile()
    lower, upper = _limits(model)
    begin = _start(path, model, start)
    if ((begin < lower) | (begin > upper)).any():
        raise FileFormatError(path, f"its start {begin.tolist()} is outside the joint limits")
    height = _numeric(path, model, "shoulder_height", 1)
    probes = [i for i in range(model.nsite) if model.site(i).name.startswith(PROBE_PREFIX)]
    radii = model.site_size[probes, 0].copy()
    own = any(bare.site(i).name.startswith(PROBE_PREFIX) for i in range(bare.nsite))
    return Robot(
        name=path.stem,
        path=path,
        joints=tuple(model.joint(i).name for i in range(n)),
        start=begin,
        starts=MappingProxyType({model.key(i).name: model.key_qpos[i].copy() for i in range(model.nkey)}),
        lower=lower,
        upper=upper,
        velocity_limits=_motion_limits(path, model, "velocity_limits", velocity_limits, DEFAULT_SPEED),
        acceleration_limits=_motion_limits(
            path, model, "acceleration_limits", acceleration_limits, DEFAULT_ACCELERATION
        ),
        shoulder_height=_shoulder_height(model) if height is None else float(height[0]),
        probes=tuple(model.site(i).name for i in probes),
        probe_radii=radii if own else np.zeros_like(radii),
        tip=tip,
    )


def _prepare(spec: mujoco.MjSpec, tip: str) -> mujoco.MjSpec:
    """The arm as scenes need it: site ``tip``, probe sites, no gravity on its links."""
    for body in spec.bodies[1:]:
        body.gravcomp = 1.0
    if not any(site.name.startswith(PROBE_PREFIX) for site in spec.sites):
        end = spec.site(tip)
        for i, joint in enumerate(spec.joints[1:]):
            joint.parent.add_site(name=f"{PROBE_PREFIX}{i}", pos=joint.pos)
        end.parent.add_site(name=f"{PROBE_PREFIX}{len(spec.joints) - 1}", pos=end.pos)
    spec.site(tip).name = TIP_SITE
    return spec


def _check_joints(path: Path, model: mujoco.MjModel) -> int:
    n = int(model.njnt)
    if n == 0 or (model.jnt_type != mujoco.mjtJoint.mjJNT_HINGE).any():
        raise FileFormatError(path, "an arm needs hinge joints and no other kind")
    for i in range(n):
        if not model.jnt_limited[i]:
            raise FileFormatError(path, f"joint {model.joint(i).name!r} has no limits: give it a range")
    if model.nu != n:
        raise FileFormatError(path, f"{n} joints, {model.nu} actuators; expected one position actuator each")
    for i in range(n):
        drives = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_trnid[i, 0] == i
        servo = model.actuator_gainprm[i, 0] > 0 and model.actuator_biasprm[i, 1] == -model.actuator_gainprm[i, 0]
        if not (drives and servo):
            raise FileFormatError(
                path, f"actuator {i} must be a position actuator of joint {model.joint(i).name!r}, in the joints' order"
            )
    if (model.geom_bodyid == 0).any():
        raise FileFormatError(path, "the world holds geoms of its own (a floor?); expected the arm alone")
    return n


def _choose(path: Path, kind: str, wanted: str | None, usual: Sequence[str], present: Sequence[str]) -> str:
    for name in usual if wanted is None else (wanted,):
        if name in present:
            return name
    looked_for = " or ".join(map(repr, usual if wanted is None else (wanted,)))
    raise FileFormatError(path, f"the arm has no {kind} named {looked_for}; it has {', '.join(present) or 'none'}")


def _limits(model: mujoco.MjModel) -> tuple[Array, Array]:
    """What both joints and actuators allow."""
    commanded = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-np.inf, np.inf])
    lower: Array = np.maximum(model.jnt_range[:, 0], commanded[:, 0])
    upper: Array = np.minimum(model.jnt_range[:, 1], commanded[:, 1])
    return lower, upper


def _start(path: Path, model: mujoco.MjModel, start: str | npt.ArrayLike | None) -> Array:
    if start is None or isinstance(start, str):
        key = _choose(path, "key frame", start, START_KEYS, [model.key(i).name for i in range(model.nkey)])
        return np.array(model.key_qpos[model.key(key).id])
    q = np.array(start, dtype=np.float64)
    if q.shape != (model.njnt,) or not np.isfinite(q).all():
        raise InvalidValueError(f"start must be {model.njnt} finite angles in radians, got {start!r}")
    return q


def _motion_limits(path: Path, model: mujoco.MjModel, name: str, given: npt.ArrayLike | None, default: float) -> Array:
    if given is not None:
        limits = np.array(given, dtype=np.float64)
        if limits.shape != (model.njnt,) or not (limits > 0).all():
            raise InvalidValueError(f"{name} must be {model.njnt} positive numbers, got {given!r}")
        return limits
    in_file = _numeric(path, model, name, model.njnt)
    return np.full(model.njnt, default) if in_file is None else in_file


def _numeric(path: Path, model: mujoco.MjModel, name: str, size: int) -> Array | None:
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if index < 0:
        return None
    first, count = model.numeric_adr[index], model.numeric_size[index]
    if count != size:
        raise FileFormatError(path, f"custom numeric {name!r} has {count} numbers, expected {size}")
    return np.array(model.numeric_data[first : first + count])


def _shoulder_height(model: mujoco.MjModel) -> float:
    """Height above the base of the first joint that lifts rather than turns the arm (of the first, if none does)."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    lifting = np.flatnonzero(np.abs(data.xaxis[:, 2]) < 0.5)
    joint = lifting[0] if len(lifting) else 0
    return float(data.xanchor[joint, 2] - data.xpos[1, 2])
