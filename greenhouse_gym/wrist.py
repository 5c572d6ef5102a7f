"""The arm looks before it reaches: its wrist camera as a rig whose cameras stand where the arm holds it."""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.rig import D435_DEPTH, Camera, Intrinsics, Rig
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import pose
from greenhouse_gym.rendering.cameras import TIP_FROM_WRIST
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.robots.robot import TIP_SITE
from greenhouse_gym.scene import ArmPlacement

LOOK_PREFIX = "look_"


def look_rig(
    robot: str | Robot = "ur5e",
    configurations: npt.ArrayLike | None = None,
    placement: ArmPlacement | None = None,
    intrinsics: Intrinsics = D435_DEPTH,
) -> Rig:
    """A rig with a camera for each configuration the arm looks from, in the frame of the arm's stand.

    Args:
        robot: The arm.
        configurations: (k, joints) radians; the arm's key frames ``look_...`` when left out.
        placement: Height of the shoulder.
        intrinsics: Intrinsics of the wrist camera.

    Returns:
        Cameras ``look_0`` and so on; the rig frame's origin is on the floor below the arm's axis, x into the plants.

    Raises:
        InvalidValueError: The arm's file has no ``look_...`` key frames and no configurations are given.
    """
    arm = get_robot(robot)
    named = [q for name, q in arm.starts.items() if name.startswith(LOOK_PREFIX)]
    chosen = np.array(named if configurations is None else configurations, dtype=np.float64)
    if chosen.ndim != 2 or chosen.shape[1] != len(arm.joints):
        raise InvalidValueError(
            f"looks: expected configurations (k, {len(arm.joints)}) or key frames {LOOK_PREFIX}0 and so on in "
            f"{arm.path}, got an array of shape {chosen.shape}"
        )
    model = arm.spec().compile()
    data, site = mujoco.MjData(model), model.site(TIP_SITE).id
    stand_from_base = pose(translation=[0.0, 0.0, (placement or ArmPlacement()).shoulder_height - arm.shoulder_height])
    cameras = {}
    for k, configuration in enumerate(chosen):
        data.qpos[:] = configuration
        mujoco.mj_kinematics(model, data)
        base_from_tip = pose(data.site_xmat[site].reshape(3, 3), data.site_xpos[site] - data.xpos[1])
        cameras[f"{LOOK_PREFIX}{k}"] = Camera(intrinsics, stand_from_base @ base_from_tip @ TIP_FROM_WRIST)
    return Rig(cameras, f"{LOOK_PREFIX}0")
