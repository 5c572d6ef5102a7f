"""Mount an arm on a cart that slides along the row on the pipe rail."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from greenhouse_gym.common.files import resolved, write_atomically
from greenhouse_gym.errors import FileFormatError, InvalidValueError, is_number
from greenhouse_gym.robots.arm_file import loading, read_arm
from greenhouse_gym.robots.load import get_robot

RAIL = "rail"
"""Name of the joint that slides along the row."""

SPEED, ACCELERATION = 0.25, 0.5
"""Speed and acceleration limits of the cart, m/s and m/s^2."""

_MASS = 60.0  # kg of cart and drive
_STIFFNESS, _DAMPING = 60_000.0, 3_600.0  # N/m and N s/m of the drive


def mount_on_rail(arm: str | Path, out: str | Path, reach: float = 0.5) -> Path:
    """Write a copy of an arm's file on a cart that slides along the row.

    The new first joint moves arm, cart and crate together. The written file can be used as any ``robot``, such as that
    of ``TomatoHarvest-v0`` with ``size="row"``.

    Args:
        arm: Name of a shipped arm, or its MJCF file.
        out: The file to write.
        reach: Distance that the cart can move to either side of its middle, metres.

    Returns:
        The written file.

    Raises:
        InvalidValueError: The reach is no positive number, or the copy would replace the arm's file.
        FileFormatError: The file contains no arm, or one whose base moves already.
    """
    if not is_number(reach) or not 0 < reach <= 100:
        raise InvalidValueError(f"reach must be metres above 0, up to 100, got {reach!r}")
    source, out = get_robot(arm).path, resolved(out)
    if out == source:
        raise InvalidValueError(f"{out}: the copy needs another file than that of the arm")
    spec = read_arm(source)
    base = spec.worldbody.first_body()
    if base.joints:
        raise FileFormatError(source, f"its base {base.name!r} moves already; give an arm with a fixed base")
    back, axis = np.empty(4), np.empty(3)
    mujoco.mju_negQuat(back, base.quat)
    mujoco.mju_rotVecQuat(axis, np.array([0.0, 1.0, 0.0]), back)
    name, robot = base.name, get_robot(arm)
    spec.meshdir = str((source.parent / spec.meshdir).resolve())
    spec.texturedir = str((source.parent / spec.texturedir).resolve())
    root = ElementTree.fromstring(spec.to_xml())
    bounds = f"{-reach} {reach}"
    body = next(element for element in root.iter("body") if element.get("name") == name)
    joint = {"name": RAIL, "type": "slide", "range": bounds, "armature": str(_MASS), "axis": _text(axis)}
    body.insert(0, ElementTree.Element("joint", joint))
    servo = {"name": RAIL, "joint": RAIL, "kp": str(_STIFFNESS), "kv": str(_DAMPING), "ctrlrange": bounds}
    actuators = root.find("actuator")
    assert actuators is not None
    actuators.insert(0, ElementTree.Element("position", servo))
    for key in root.iter("key"):
        for field in ("qpos", "ctrl"):
            if key.get(field):
                key.set(field, f"0 {key.get(field)}")
    custom = root.find("custom")
    custom = ElementTree.SubElement(root, "custom") if custom is None else custom
    limits = {
        "velocity_limits": (SPEED, robot.velocity_limits),
        "acceleration_limits": (ACCELERATION, robot.acceleration_limits),
    }
    for old in [one for one in custom if one.get("name") in limits]:
        custom.remove(old)
    for field, (own, others) in limits.items():
        ElementTree.SubElement(custom, "numeric", {"name": field, "data": _text([own, *others])})
    with loading(out):
        text = ElementTree.tostring(root, encoding="unicode")
        mujoco.MjSpec.from_string(text).compile()
    return write_atomically(out, text)


def _text(values: object) -> str:
    return " ".join(f"{value:.9g}" for value in np.asarray(values, dtype=np.float64))
