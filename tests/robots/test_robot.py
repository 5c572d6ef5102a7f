from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from greenhouse_gym.errors import FileFormatError, UnknownNameError
from greenhouse_gym.robots import ROBOTS, Robot, get_robot

# the manufacturer's Denavit-Hartenberg parameters of the UR5e: d, a in metres, alpha in radians
DH = [
    (0.1625, 0.0, np.pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.3922, 0.0),
    (0.1333, 0.0, np.pi / 2),
    (0.0997, 0.0, -np.pi / 2),
    (0.0996, 0.0, 0.0),
]


def flange_by_dh(q: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    for angle, (d, a, alpha) in zip(q, DH, strict=True):
        c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
        pose = pose @ [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    return np.diag([-1.0, -1.0, 1.0, 1.0]) @ pose  # our base is turned by half a turn


@pytest.fixture(scope="module", params=sorted(ROBOTS))
def robot(request: pytest.FixtureRequest) -> Robot:
    return get_robot(request.param)


def test_ur5e_follows_the_published_kinematics() -> None:
    robot = get_robot("ur5e")
    model = robot.spec().compile()
    data = mujoco.MjData(model)
    flange = model.site("flange").id
    random = np.random.default_rng(0)
    tool_turns = []
    for q in [np.zeros(6), robot.start, *random.uniform(robot.lower, robot.upper, (300, 6))]:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        expected = flange_by_dh(q)
        np.testing.assert_allclose(data.site_xpos[flange], expected[:3, 3], atol=1e-9)
        turn = expected[:3, :3].T @ data.site_xmat[flange].reshape(3, 3)
        np.testing.assert_allclose(turn[:, 2], [0, 0, 1], atol=1e-9)  # the tool points out of the flange
        tool_turns.append(turn)
    np.testing.assert_allclose(tool_turns, np.broadcast_to(tool_turns[0], (len(tool_turns), 3, 3)), atol=1e-9)


def test_ur5e_carries_a_slender_gripper_along_the_tool_axis() -> None:
    model = get_robot("ur5e").spec().compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    flange, tip = model.site("flange").id, model.site("tip").id
    axis = data.site_xmat[flange].reshape(3, 3)[:, 2]
    np.testing.assert_allclose(data.site_xpos[tip] - data.site_xpos[flange], 0.16 * axis, atol=1e-9)
    np.testing.assert_allclose(data.site_xmat[tip].reshape(3, 3)[:, 2], axis, atol=1e-9)
    for name in ("rod", "cup"):
        assert model.geom(name).size[0] == pytest.approx(0.012)
        reach = data.geom_xpos[model.geom(name).id] + axis * (model.geom(name).size[1] + 0.012)
        assert (reach - data.site_xpos[tip]) @ axis <= 1e-9  # no part lies beyond the tip


def test_no_self_collision_at_the_start(robot: Robot) -> None:
    model = robot.spec().compile()
    data = mujoco.MjData(model)
    data.qpos[:] = robot.start
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    assert ((robot.lower < robot.start) & (robot.start < robot.upper)).all()


def test_a_folded_arm_touches_itself() -> None:
    model = get_robot("ur5e").spec().compile()
    data = mujoco.MjData(model)
    data.qpos[2] = 3.0
    mujoco.mj_forward(model, data)
    assert data.ncon > 0


def test_the_arm_stays_at_its_start_when_nothing_is_commanded(robot: Robot) -> None:
    model = robot.spec().compile()
    model.opt.timestep, model.opt.integrator = 0.01, mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # as in every scene
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    mujoco.mj_step(model, data, 500)
    assert data.time == pytest.approx(5.0)  # no reset because of a diverging simulation
    np.testing.assert_allclose(data.qpos, robot.start, atol=1e-6)


def test_records_fit_the_model(robot: Robot) -> None:
    n = len(robot.joints)
    for array in (robot.start, robot.lower, robot.upper, robot.velocity_limits, robot.acceleration_limits):
        assert array.shape == (n,)
    assert (robot.velocity_limits > 0).all()
    assert (robot.acceleration_limits > 0).all()
    assert len(robot.probes) == len(robot.probe_radii) > 0
    assert robot.name in ROBOTS
    assert get_robot(robot) is robot
    assert get_robot(robot.name) is robot


def test_an_unknown_robot_lists_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match=r"'ur5'.*Did you mean 'ur5e'"):
        get_robot("ur5")


# -- files that are no arms -------------------------------------------------------------------------------------------

GOOD = """<mujoco><worldbody><body><joint name="one" axis="0 0 1" range="-90 90"/><geom size="0.05"/>
<site name="tip"/></body></worldbody>
<custom><numeric name="velocity_limits" data="3"/><numeric name="acceleration_limits" data="10"/>
<numeric name="shoulder_height" data="0.2"/></custom>
<actuator><position joint="one" kp="10"/></actuator><keyframe><key name="start" qpos="0.1"/></keyframe></mujoco>"""


def test_an_arm_of_ones_own(tmp_path: Path) -> None:
    file = tmp_path / "mine.xml"
    file.write_text(GOOD)
    robot = get_robot(file)
    assert (robot.name, robot.joints, robot.shoulder_height) == ("mine", ("one",), 0.2)
    np.testing.assert_allclose([robot.lower[0], robot.upper[0]], [-np.pi / 2, np.pi / 2])
    np.testing.assert_array_equal(robot.start, [0.1])
    assert get_robot(str(file)).probes == ("probe_0",)  # the tip itself


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('<site name="tip"/>', "", "site named 'tip'"),
        ('<position joint="one" kp="10"/>', "", "1 joints, 0 actuators"),
        ('<key name="start" qpos="0.1"/>', "", "key frame named 'start'"),
        ('<joint name="one" axis="0 0 1" range="-90 90"/>', '<joint name="one" axis="0 0 1"/>', "'one' has no limits"),
        ('<position joint="one" kp="10"/>', '<motor joint="one"/>', "position actuator of joint 'one'"),
        ('kp="10"/>', 'kp="10"/><position joint="one" kp="10"/>', "1 joints, 2 actuators"),
        ("<worldbody>", '<worldbody><geom size="1"/>', "the arm alone"),
        ('qpos="0.1"', 'qpos="9"', "outside the joint limits"),
        (
            'name="acceleration_limits" data="10"',
            'name="acceleration_limits" data="10 10"',
            "has 2 numbers, expected 1",
        ),
        ('<joint name="one" axis="0 0 1"', '<joint name="one" type="slide" axis="0 0 1"', "hinge joints"),
        ('<joint name="one" axis="0 0 1" range="-90 90"/>', "", "MuJoCo cannot load it"),
        ("</mujoco>", "", "MuJoCo cannot load it"),
    ],
)
def test_a_file_that_is_no_arm_says_what_is_missing(tmp_path: Path, old: str, new: str, problem: str) -> None:
    assert old in GOOD
    file = tmp_path / "broken.xml"
    file.write_text(GOOD.replace(old, new))
    with pytest.raises(FileFormatError, match=rf"broken\.xml: .*{problem}"):
        get_robot(file)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"none\.xml"):
        get_robot(tmp_path / "none.xml")
