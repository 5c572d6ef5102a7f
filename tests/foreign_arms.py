"""Arms that know nothing of this package, in the manner of MuJoCo Menagerie, whose own need a download.

Kinematics, limits, servos, names and key frames follow the makers' data as Menagerie's files give them; the links are
capsules. What makes these arms hard to take in is here: no names and usual masks on the geoms, a base in two bodies or
turned by a quarter, a shoulder that reaches below the base, a flange site instead of a tip, joints without limits, a
home in the plants.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from pathlib import Path

PI = 3.14159265


@dataclass(frozen=True)
class Link:
    """A body after a joint: where it sits on the one before, its axis and limits, and the capsules it is made of."""

    pos: str
    quat: str = "1 0 0 0"
    axis: str = "0 0 1"
    limits: tuple[float, float] = (-inf, inf)
    capsules: tuple[tuple[str, float], ...] = ()  # the axis' ends, the radius
    kind: str = "hinge"


@dataclass(frozen=True)
class Arm:
    """A chain of links on a base."""

    links: tuple[Link, ...]
    base: str  # its geoms, if any
    base_quat: str
    site: str  # at the flange
    servo: str
    joint: str
    home: str


FR3 = Arm(
    links=(
        Link("0 0 0.333", limits=(-2.9007, 2.9007), capsules=(("0 0 -0.14 0 0 0", 0.055),)),
        Link("0 0 0", "1 -1 0 0", limits=(-1.8361, 1.8361), capsules=(("0 0 0.01 0 -0.15 0.01", 0.055),)),
        Link("0 -0.316 0", "1 1 0 0", limits=(-2.9007, 2.9007), capsules=(("0 0 -0.1 0 0 0", 0.055),)),
        Link("0.0825 0 0", "1 1 0 0", limits=(-3.077, -0.1169), capsules=(("0 0 0.01 -0.08 0.1 0.01", 0.05),)),
        Link("-0.0825 0.384 0", "1 -1 0 0", limits=(-2.8763, 2.8763), capsules=(("0 0 -0.23 0 0.05 -0.05", 0.05),)),
        Link("0 0 0", "1 1 0 0", limits=(0.4398, 4.6216), capsules=(("0 0 -0.01 0.07 0 -0.01", 0.045),)),
        Link("0.088 0 0", "1 1 0 0", limits=(-3.0508, 3.0508), capsules=(("0 0 0.03 0 0 0.06", 0.045),)),
    ),
    base='<geom type="capsule" size="0.06" fromto="-0.05 0 0.06 0 0 0.06"/>',
    base_quat="1 0 0 0",
    site='<site name="attachment_site" pos="0 0 0.107"/>',
    servo='<position kp="4500" kv="450" inheritrange="1"/>',
    joint='<joint armature="0.195" damping="0.21" frictionloss="1"/>',
    home="0 0 0 -1.57079 0 1.57079 -0.7853",
)

XARM7 = Arm(
    links=(
        Link("0 0 0.267", limits=(-2 * PI, 2 * PI), capsules=(("0 0 -0.1 0 0 0", 0.05),)),
        Link("0 0 0", "1 -1 0 0", limits=(-2.059, 2.0944), capsules=(("0 0 0 0 -0.18 0", 0.05),)),
        Link("0 -0.293 0", "1 1 0 0", limits=(-2 * PI, 2 * PI), capsules=(("0 0 0 0.0525 0 0", 0.048),)),
        Link("0.0525 0 0", "1 1 0 0", limits=(-0.19198, 3.927), capsules=(("0.02 -0.03 0 0.0775 -0.2 0", 0.045),)),
        Link("0.0775 -0.3425 0", "1 1 0 0", limits=(-2 * PI, 2 * PI), capsules=(("0 0.02 -0.06 0 0 0", 0.045),)),
        Link("0 0 0", "1 1 0 0", limits=(-1.69297, PI), capsules=(("0 0 0 0.07 0.05 0", 0.04),)),
        Link("0.076 0.097 0", "1 -1 0 0", limits=(-2 * PI, 2 * PI), capsules=(("0 0 -0.045 0 0 -0.04", 0.036),)),
    ),
    base='<geom type="capsule" size="0.06" fromto="0 0 0.06 0 0 0.13"/>',
    base_quat="1 0 0 0",
    site='<site name="attachment_site"/>',
    servo='<general gainprm="1000" biastype="affine" biasprm="0 -1000 -100"/>',
    joint='<joint armature="0.1" damping="5" frictionloss="1"/>',
    home="0 -0.247 0 0.909 0 1.15644 0",
)

UR10E = Arm(
    links=(
        Link("0 0 0.181", "1 0 0 0", "0 0 1", (-2 * PI, 2 * PI), (("0 0 -0.13 0 0 0.03", 0.078),)),
        Link(
            "0 0.176 0", "1 0 1 0", "0 1 0", (-2 * PI, 2 * PI),
            (("0 -0.13 0 0 0.03 0", 0.078), ("0 0 0 0 0 0.6", 0.06)),
        ),
        Link(
            "0 -0.137 0.613", "1 0 0 0", "0 1 0", (-PI, PI),
            (("0 0.015 0 0 0.145 0", 0.058), ("0 0 0.01 0 0 0.57", 0.043)),
        ),
        Link("0 0 0.571", "1 0 1 0", "0 1 0", (-2 * PI, 2 * PI), (("0 -0.01 0 0 0.13 0", 0.05),)),
        Link(
            "0 0.135 0", "1 0 0 0", "0 0 1", (-2 * PI, 2 * PI),
            (("0 0 -0.015 0 0 0.115", 0.046), ("0 -0.015 0.12 0 0.071 0.12", 0.046)),
        ),
        Link("0 0 0.12", "1 0 0 0", "0 1 0", (-2 * PI, 2 * PI), (("0 0.05 0 0 0.06 0", 0.046),)),
    ),
    base="",
    base_quat="1 0 0 1",
    site='<site name="attachment_site" pos="0 0.1 0" quat="-1 1 0 0"/>',
    servo='<position kp="4000" forcerange="-330 330"/>',
    joint='<joint armature="0.1" damping="300"/>',
    home="-1.5708 -1.5708 1.5708 -1.5708 -1.5708 0",
)  # fmt: skip

GEN3 = Arm(
    links=(
        Link("0 0 0.15643", "0 1 0 0", capsules=(("0 0 -0.1 0 0 -0.03", 0.045),)),
        Link("0 0.005375 -0.12838", "1 1 0 0", limits=(-2.24, 2.24), capsules=(("0 0 0 0 -0.18 0", 0.045),)),
        Link("0 -0.21038 -0.006375", "1 -1 0 0", capsules=(("0 0 -0.03 0 0 -0.18", 0.04),)),
        Link("0 0.006375 -0.21038", "1 1 0 0", limits=(-2.57, 2.57), capsules=(("0 0 0 0 -0.18 0", 0.04),)),
        Link("0 -0.20843 -0.006375", "1 -1 0 0", capsules=(("0 0 -0.03 0 0 -0.08", 0.036),)),
        Link("0 0.00017505 -0.10593", "1 1 0 0", limits=(-2.09, 2.09), capsules=(("0 0 0 0 -0.08 0", 0.036),)),
        Link("0 -0.10593 -0.00017505", "1 -1 0 0", capsules=(("0 0 -0.005 0 0 -0.025", 0.036),)),
    ),
    base='<geom type="capsule" size="0.045" fromto="0 0 0.045 0 0 0.1"/>',
    base_quat="1 0 0 0",
    site='<site name="pinch_site" pos="0 0 -0.061525" quat="0 1 0 0"/>',
    servo='<position kp="2000" kv="100" forcerange="-105 105"/>',
    joint='<joint armature="0.1"/>',
    home="0 0.26179939 3.14159265 -2.26892803 0 0.95993109 1.57079633",
)

RAIL_ARM = Arm(
    links=(
        Link("0 0 0", axis="0 1 0", limits=(-0.3, 0.3), kind="slide", capsules=(("-0.05 0 0.07 0.05 0 0.07", 0.05),)),
        Link("0 0 0.13", axis="0 0 1", limits=(0.0, 0.4), kind="slide", capsules=(("0 0 0.05 0 0 0.1", 0.045),)),
        Link("0 0 0.16", axis="0 0 1", limits=(-2.9, 2.9), capsules=(("0 0 0.04 0 0 0.05", 0.045),)),
        Link("0 0 0.1", axis="0 1 0", limits=(-2.0, 2.0), capsules=(("0 0 0.06 0 0 0.3", 0.04),)),
        Link("0 0 0.35", axis="0 1 0", limits=(-2.6, 2.6), capsules=(("0 0 0.06 0 0 0.25", 0.035),)),
        Link("0 0 0.3", axis="0 1 0", limits=(-2.0, 2.0), capsules=(("0 0 0.06 0 0 0.07", 0.03),)),
    ),
    base="",
    base_quat="1 0 0 0",
    site='<site name="attachment_site" pos="0 0 0.1"/>',
    servo='<position kp="4000" kv="240"/>',
    joint='<joint armature="0.1" damping="2"/>',
    home="0 0.1 0 -1.2 2.2 0",
)
"""Not one of Menagerie: an arm of four hinges on a rail along the row and a lift."""

ARMS = {"fr3": FR3, "xarm7": XARM7, "ur10e": UR10E, "gen3": GEN3, "rail_arm": RAIL_ARM}


def write_arm(name: str, folder: Path) -> Path:
    """Write one of `ARMS` as an MJCF file without a tool."""
    arm = ARMS[name]
    opening, closing, actuators = "", "", ""
    for i, link in enumerate(arm.links, start=1):
        limited = link.limits[0] > -inf
        span = f' range="{link.limits[0]} {link.limits[1]}"' if limited else ""
        control = f' ctrlrange="{link.limits[0]} {link.limits[1]}"' if limited and "inherit" not in arm.servo else ""
        geoms = "".join(
            f'<geom type="capsule" size="{radius}" fromto="{ends}" mass="1"/>' for ends, radius in link.capsules
        )
        opening += (
            f'<body name="link{i}" pos="{link.pos}" quat="{link.quat}">'
            f'<joint name="joint{i}" type="{link.kind}" axis="{link.axis}"{span}/>{geoms}'
        )
        closing += "</body>"
        kind = arm.servo.split()[0][1:]
        actuators += f'<{kind} class="arm" name="act{i}" joint="joint{i}"{control}/>'
    path = folder / f"{name}.xml"
    path.write_text(
        f"""<mujoco model="{name}"><compiler angle="radian" autolimits="true"/>
<default><default class="arm">{arm.joint}{arm.servo}</default></default>
<worldbody><light pos="0 0 2"/><body name="base" childclass="arm" quat="{arm.base_quat}">
<body name="link0">{arm.base}<inertial pos="0 0 0.05" mass="3" diaginertia="0.01 0.01 0.01"/>
{opening}{arm.site}{closing}</body></body></worldbody>
<actuator>{actuators}</actuator><keyframe><key name="home" qpos="{arm.home}"/></keyframe></mujoco>"""
    )
    return path
