from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import make_scene

from greenhouse_gym.errors import FileFormatError, GreenhouseError, UnknownNameError
from greenhouse_gym.robots import ROBOTS, Robot, get_robot, load_robot
from greenhouse_gym.robots.kinematics import tool_chain, tool_state
from greenhouse_gym.robots.start import ahead_of_base
from greenhouse_gym.scene import compile_scene

# the manufacturer's Denavit-Hartenberg parameters of the UR5e: d, a in metres, alpha in radians
DH = [
    (0.1625, 0.0, np.pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.3922, 0.0),
    (0.1333, 0.0, np.pi / 2),
    (0.0997, 0.0, -np.pi / 2),
    (0.0996, 0.0, 0.0),
]


# the same of the LBR iiwa 14 R820, from the distances of its data sheet: 360, 420, 400 and 126 mm
DH_IIWA = [
    (0.360, 0.0, -np.pi / 2),
    (0.0, 0.0, np.pi / 2),
    (0.420, 0.0, np.pi / 2),
    (0.0, 0.0, -np.pi / 2),
    (0.400, 0.0, -np.pi / 2),
    (0.0, 0.0, np.pi / 2),
    (0.126, 0.0, 0.0),
]


def flange_by_dh(q: np.ndarray, parameters: list[tuple[float, float, float]]) -> np.ndarray:
    pose = np.eye(4)
    for angle, (d, a, alpha) in zip(q, parameters, strict=True):
        c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
        pose = pose @ [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    return pose


@pytest.fixture(scope="module", params=sorted(ROBOTS))
def robot(request: pytest.FixtureRequest) -> Robot:
    return get_robot(request.param)


@pytest.mark.parametrize(
    ("name", "parameters", "turn"),
    [("ur5e", DH, [-1, -1, 1, 1]), ("iiwa14", DH_IIWA, [1, 1, 1, 1])],  # the UR5e's base is turned by half a turn
)
def test_arms_follow_the_published_kinematics(
    name: str, parameters: list[tuple[float, float, float]], turn: list[float]
) -> None:
    robot = get_robot(name)
    model = robot.spec().compile()
    data = mujoco.MjData(model)
    flange = model.site("flange").id
    random = np.random.default_rng(0)
    tool_turns = []
    for q in [
        np.zeros(len(parameters)),
        robot.start,
        *random.uniform(robot.lower, robot.upper, (300, len(parameters))),
    ]:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        expected = np.diag(turn) @ flange_by_dh(q, parameters)
        np.testing.assert_allclose(data.site_xpos[flange], expected[:3, 3], atol=1e-9)
        tool_turn = expected[:3, :3].T @ data.site_xmat[flange].reshape(3, 3)
        np.testing.assert_allclose(tool_turn[:, 2], [0, 0, 1], atol=1e-9)  # the tool points out of the flange
        tool_turns.append(tool_turn)
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
    mujoco.mj_resetDataKeyframe(model, data, model.key("ready").id)
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


def test_iiwa14_has_the_published_limits() -> None:
    robot = get_robot("iiwa14")
    np.testing.assert_allclose(np.degrees(robot.upper), [170, 120, 170, 120, 170, 120, 175], atol=1e-3)
    np.testing.assert_array_equal(robot.lower, -robot.upper)
    np.testing.assert_allclose(np.degrees(robot.velocity_limits), [85, 85, 100, 75, 130, 135, 135], atol=0.01)
    np.testing.assert_array_equal(robot.starts["upright"], np.zeros(7))


# -- arms that know nothing of this package ---------------------------------------------------------------------------

MENAGERIE_STYLE = """<mujoco model="two links"><compiler angle="degree"/>
<default><default class="arm"><joint axis="0 1 0" range="-100 100"/><geom mass="1"/>
<general gaintype="fixed" biastype="affine" gainprm="2000" biasprm="0 -2000 -200"/></default></default>
<worldbody><light pos="0 0 3"/><body name="link0" childclass="arm"><geom size="0.05" pos="0 0 0.05"/>
<body name="link1" pos="0 0 0.3"><joint name="j1"/><geom type="capsule" size="0.04" fromto="0 0 0.05 0 0 0.35"/>
<body name="link2" pos="0 0 0.4"><joint name="j2" axis="1 0 0"/>
<geom type="capsule" size="0.03" fromto="0 0 0.05 0 0 0.25"/>
<site name="attachment_site" pos="0 0 0.3"/></body></body></body></worldbody>
<actuator><general class="arm" joint="j1"/>
<general class="arm" joint="j2" ctrlrange="-0.5 9" ctrllimited="true"/></actuator>
<keyframe><key name="home" qpos="0.2 0.1"/></keyframe></mujoco>"""


def test_an_arm_as_in_mujoco_menagerie_is_understood(tmp_path: Path) -> None:
    file = tmp_path / "two.xml"
    file.write_text(MENAGERIE_STYLE)
    robot = get_robot(file)
    assert robot.tip == "attachment_site"
    assert (robot.joints, robot.probes) == (("j1", "j2"), ("probe_0", "probe_1"))
    assert robot.shoulder_height == pytest.approx(0.3)
    np.testing.assert_allclose(np.degrees(robot.upper), [100, 100])
    np.testing.assert_allclose(robot.lower, [np.radians(-100), -0.5])  # what its actuator may be told
    np.testing.assert_array_equal(robot.start, [0.2, 0.1])
    np.testing.assert_array_equal(load_robot(file, start=[0.5, 0.0]).start, [0.5, 0.0])
    np.testing.assert_array_equal(load_robot(file, velocity_limits=[1, 2]).velocity_limits, [1, 2])
    # its degrees stay degrees in a scene, and gravity does not pull it down
    model = compile_scene(make_scene(0), robot).model
    np.testing.assert_allclose(np.degrees(model.jnt_range), [[-100, 100]] * 2)
    assert (model.body_gravcomp[1:] == 1).all()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.site_xpos[model.site("tip").id], [0, 0, 1.1 + 0.7], atol=1e-9)


@pytest.mark.parametrize(
    ("keywords", "problem"),
    [({"tip": "nose"}, "attachment_site"), ({"start": "bed"}, "'bed'; it has home"), ({"start": [0.1]}, "2 finite")],
)
def test_wrong_names_for_an_arm_list_the_right_ones(tmp_path: Path, keywords: dict[str, object], problem: str) -> None:
    file = tmp_path / "two.xml"
    file.write_text(MENAGERIE_STYLE)
    with pytest.raises(GreenhouseError, match=problem):
        load_robot(file, **keywords)


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
        ('<key name="start" qpos="0.1"/>', "", "key frame named 'ready' or 'start'"),
        ('<position joint="one" kp="10"/>', '<motor joint="one"/>', "position actuator of joint 'one'"),
        ('kp="10"/>', 'kp="10"/><position joint="one" kp="10"/>', "1 joints, 2 actuators"),
        ("<worldbody>", '<worldbody><geom size="1"/>', "the arm alone"),
        ('qpos="0.1"', 'qpos="9"', "outside the joint limits"),
        (
            'name="acceleration_limits" data="10"',
            'name="acceleration_limits" data="10 10"',
            "has 2 numbers, expected 1",
        ),
        (
            '<joint name="one" axis="0 0 1" range="-90 90"/>',
            '<joint name="one" type="slide"/>',
            "slide joint 'one' has no limits",
        ),
        ('<joint name="one" axis="0 0 1" range="-90 90"/>', '<joint name="one" type="ball"/>', "hinge or slide joints"),
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


def test_folded_away_the_arm_stays_over_the_aisle(robot: Robot) -> None:
    """Leaves hang up to 0.4 m out of the row, whose stems are 0.6 m away, and the row across begins 1 m behind."""
    compiled = compile_scene(make_scene(0), robot)
    model, data = compiled.model, mujoco.MjData(compiled.model)
    data.qpos[:] = robot.starts["folded"]
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    arm = np.flatnonzero(model.geom_bodyid > 0)
    along = data.geom_xmat[arm].reshape(-1, 3, 3)[:, :, 2] * model.geom_size[arm, 1:2]
    ends = np.stack([data.geom_xpos[arm] - along, data.geom_xpos[arm] + along])  # an arm is made of capsules
    radius = model.geom_size[arm, 0, None]
    low, high = (ends - radius).min(axis=(0, 1)), (ends + radius).max(axis=(0, 1))
    assert -0.6 < low[0] < high[0] < 0.1
    assert high[2] < 1.4


def test_a_start_is_named_or_given(robot: Robot) -> None:
    assert robot.configuration(None) is robot.start
    np.testing.assert_array_equal(robot.configuration("ready"), robot.start)
    given = robot.start + 0.1
    assert robot.configuration(given) is given
    with pytest.raises(UnknownNameError, match="folded"):
        robot.configuration("asleep")


def test_an_arm_is_ready_at_its_start(robot: Robot) -> None:
    model = robot.spec().compile()
    tool = tool_state(tool_chain(model, model.site("tip").id), robot.start[None])
    jacobian = np.concatenate([tool.jacobian[0], 0.3 * tool.joint_axes[0]])
    assert np.linalg.svd(jacobian, compute_uv=False)[-1] > 0.03  # the tool can move and turn in all directions
    assert tool.axis[0, 0] > 0.85  # forward
    assert 0.05 < tool.point[0, 0] < 0.2
    assert ahead_of_base(model, robot.start) < 0.25
    np.testing.assert_array_equal(robot.upright_start, robot.starts["upright"])
    assert robot.rating_start is robot.starts["ready"]
    assert np.array_equal(robot.start, robot.starts["ready"])


def test_the_last_joint_rolls_the_tool(robot: Robot) -> None:
    assert robot.rolls_tool
    configurations = np.ones((2, len(robot.joints)))
    robot.keep_tool_roll(configurations, np.zeros(len(robot.joints)))
    assert (configurations[:, -1] == 0).all()
    assert (configurations[:, :-1] == 1).all()


def test_an_arm_whose_last_joint_tilts_the_tool_has_no_tool_roll(tmp_path: Path) -> None:
    file = tmp_path / "tilted.xml"
    file.write_text(ROBOTS["ur5e"].read_text().replace('name="wrist_3" axis="0 1 0"', 'name="wrist_3" axis="1 0 0"'))
    arm = load_robot(file)
    assert not arm.rolls_tool
    configurations = np.ones((2, len(arm.joints)))
    arm.keep_tool_roll(configurations, arm.start)
    assert (configurations == 1).all()
