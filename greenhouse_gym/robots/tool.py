"""The package's slender suction gripper, mounted at the flange of any arm."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.files import resolved, write_atomically
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.robots.arm_file import read_arm
from greenhouse_gym.robots.load import FLANGE_SITES, find_name, load_robot
from greenhouse_gym.robots.prepare import CUP_GEOM, PROBE_PREFIX, TIP_SITE

LENGTH, RADIUS = 0.16, 0.012
"""Length of the gripper from the flange to the tip, and radius of its rod and cup, metres."""

_ROD, _CUP = (0.005, 0.123), (0.132, 0.148)  # metres from the flange: ends of the capsules' axes


def mount_tool(
    arm: str | Path, out: str | Path, flange: str | None = None, start: str | npt.ArrayLike | None = "ready"
) -> Path:
    """Write a copy of an arm's file with the gripper of the shipped arms at its flange and a collision-free start.

    The written file can be used as any ``robot``. It refers to the arm's meshes in their folder.

    Args:
        arm: The MJCF file of an arm without a tool, such as one of MuJoCo Menagerie.
        out: The file to write.
        flange: Name of the site at the flange, z out of it; one of `FLANGE_SITES` when left out.
        start: As for `load_robot`.

    Returns:
        The written file.

    Raises:
        InvalidValueError: The copy would replace the arm's file.
        FileFormatError: The file contains no arm, no such site, or already a site ``tip`` or a geom ``cup``.
    """
    arm, out = resolved(arm), resolved(out)
    if out == arm:
        raise InvalidValueError(f"{out}: the copy needs another file than that of the arm")
    spec = read_arm(arm)
    model = spec.compile()
    sites = [model.site(i).name for i in range(model.nsite)]
    flange = find_name(arm, "site", flange, FLANGE_SITES, sites)
    if TIP_SITE in sites or CUP_GEOM in [geom.name for geom in spec.geoms]:
        raise FileFormatError(arm, f"it already has a tool: a site {TIP_SITE!r} or a geom {CUP_GEOM!r}")
    site = model.site(flange)
    tool = spec.site(flange).parent.add_body(name="suction_tool", pos=site.pos, quat=site.quat)
    _add_tool(tool)
    names = [model.joint(i).name for i in range(model.njnt)]
    for i, name in enumerate(names):
        anchor = spec.joint(name)
        if i:
            anchor.parent.add_site(name=f"{PROBE_PREFIX}{i - 1}", pos=anchor.pos, size=[0.05, 0, 0], group=4)
    for k, along in enumerate((0.02, 0.085, _CUP[1])):
        tool.add_site(name=f"{PROBE_PREFIX}{model.njnt - 1 + k}", pos=[0, 0, along], size=[RADIUS, 0, 0], group=4)
    spec.compile()
    spec.meshdir = str((arm.parent / spec.meshdir).resolve())
    spec.texturedir = str((arm.parent / spec.texturedir).resolve())
    write_atomically(out, spec.to_xml())
    begin = load_robot(out, start=start).start
    for key in spec.keys:
        if key.name == "ready":
            spec.delete(key)
    spec.add_key(name="ready", qpos=begin)
    spec.compile()
    return write_atomically(out, spec.to_xml())


def _add_tool(tool: mujoco.MjsBody) -> None:
    parts = (("rod", _ROD, 0.15, 0.3), (CUP_GEOM, _CUP, 0.02, 0.1))
    for name, (low, high), mass, gray in parts:
        tool.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[RADIUS, (high - low) / 2, 0],
            pos=[0, 0, (low + high) / 2], mass=mass, rgba=[gray, gray, gray, 1], contype=1, conaffinity=1, group=0,
        )  # fmt: skip
    tool.add_site(name=TIP_SITE, pos=np.array([0, 0, LENGTH]), size=[0.006, 0, 0], rgba=[1, 0, 0, 1])
