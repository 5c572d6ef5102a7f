"""A robot arm: an MJCF file that carries its own start, limits, tip and probe points, and the record read from it.

What the file must hold: hinge joints only, one position actuator per joint, a site ``tip`` (z along the tool), a key
frame ``start``, and the custom numerics ``velocity_limits`` (rad/s), ``acceleration_limits`` (rad/s^2) and
``shoulder_height`` (m above the base). A geom ``cup`` is the part that may touch the target; sites ``probe_*`` mark
the points at which the clearance of the arm is observed, with the radius of the arm there as their size.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

from greenhouse_gym.errors import FileFormatError, UnknownNameError
from greenhouse_gym.geometry import Array

_HERE = Path(__file__).parent
ROBOTS: dict[str, Path] = {path.stem: path for path in sorted(_HERE.glob("*.xml"))}
"""The shipped arms by name, each with its MJCF file."""

TIP_SITE, CUP_GEOM, START_KEY, PROBE_PREFIX = "tip", "cup", "start", "probe_"


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot arm.

    Attributes:
        name: Short name, the stem of its file.
        path: The MJCF file.
        joints: Names of the n joints, in order.
        start: (n,) configuration an episode starts from, radians.
        lower: (n,) lower joint limits, radians.
        upper: (n,) upper joint limits, radians.
        velocity_limits: (n,) rad/s.
        acceleration_limits: (n,) rad/s^2.
        shoulder_height: Height of the shoulder above the base, metres.
        probes: Names of the k sites at which clearance is observed.
        probe_radii: (k,) radius of the arm at those sites, metres.
    """

    name: str
    path: Path
    joints: tuple[str, ...]
    start: Array
    lower: Array
    upper: Array
    velocity_limits: Array
    acceleration_limits: Array
    shoulder_height: float
    probes: tuple[str, ...]
    probe_radii: Array

    def spec(self) -> mujoco.MjSpec:
        """A fresh, editable MuJoCo specification of the arm alone."""
        return mujoco.MjSpec.from_file(str(self.path))


def get_robot(robot: str | Path | Robot) -> Robot:
    """Find an arm by its shipped name or by the path of an MJCF file.

    Raises:
        UnknownNameError: Neither a shipped name nor an existing file.
        FileFormatError: The file lacks something an arm needs; the message says what.
    """
    if isinstance(robot, Robot):
        return robot
    if str(robot) in ROBOTS:
        return _read_robot(ROBOTS[str(robot)])
    if str(robot).endswith(".xml"):
        return _read_robot(Path(robot).resolve())
    raise UnknownNameError("robot", str(robot), [*ROBOTS, "(or the path of an MJCF file, ending in .xml)"])


@cache
def _read_robot(path: Path) -> Robot:
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, OSError) as error:
        raise FileFormatError(path, f"MuJoCo cannot load it: {error}") from error

    def require(kind: mujoco.mjtObj, name: str, what: str) -> int:
        index = mujoco.mj_name2id(model, kind, name)
        if index < 0:
            raise FileFormatError(path, f"the arm has no {what} named {name!r}")
        return int(index)

    def numeric(name: str, size: int) -> Array:
        index = require(mujoco.mjtObj.mjOBJ_NUMERIC, name, "custom numeric")
        first, count = model.numeric_adr[index], model.numeric_size[index]
        if count != size:
            raise FileFormatError(path, f"custom numeric {name!r} has {count} numbers, expected {size}")
        return np.array(model.numeric_data[first : first + count])

    if model.njnt == 0 or (model.jnt_type != mujoco.mjtJoint.mjJNT_HINGE).any():
        raise FileFormatError(path, "an arm needs hinge joints and no other kind")
    if model.nu != model.njnt:
        raise FileFormatError(path, f"{model.njnt} joints, {model.nu} actuators; expected one position actuator each")
    require(mujoco.mjtObj.mjOBJ_SITE, TIP_SITE, "site")
    start = model.key_qpos[require(mujoco.mjtObj.mjOBJ_KEY, START_KEY, "key frame")].copy()
    probes = [i for i in range(model.nsite) if model.site(i).name.startswith(PROBE_PREFIX)]
    n = model.njnt
    return Robot(
        name=path.stem,
        path=path,
        joints=tuple(model.joint(i).name for i in range(n)),
        start=start,
        lower=model.jnt_range[:, 0].copy(),
        upper=model.jnt_range[:, 1].copy(),
        velocity_limits=numeric("velocity_limits", n),
        acceleration_limits=numeric("acceleration_limits", n),
        shoulder_height=float(numeric("shoulder_height", 1)[0]),
        probes=tuple(model.site(i).name for i in probes),
        probe_radii=model.site_size[probes, 0].copy(),
    )
