"""Arms in the manner of MuJoCo Menagerie, through all that is done with an arm; and Menagerie's own where they lie."""

from __future__ import annotations

import copy
import pickle
import warnings
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import make_scene
from foreign_arms import ARMS, write_arm

from greenhouse_gym.agents import PlannerAgent
from greenhouse_gym.envs import GreenhouseEnv, GreenhouseVectorEnv
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.planning import CollisionChecker, goal_configurations, path_clearance, planning_model
from greenhouse_gym.robots import ROBOTS, Robot, get_robot, load_robot, mount_tool
from greenhouse_gym.robots.kinematics import tool_chain, tool_state
from greenhouse_gym.robots.start import ahead_of_base
from greenhouse_gym.scene import SceneBank, compile_scene


@pytest.fixture(scope="module", params=sorted(ARMS))
def mounted(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Robot:
    folder = tmp_path_factory.mktemp("arms")
    return get_robot(mount_tool(write_arm(request.param, folder), folder / f"{request.param}-tool.xml"))


def test_a_mounted_arm_starts_free_before_the_plants(mounted: Robot) -> None:
    """It neither stands in the plants nor near its cart, in the first and the last scene, and nothing warns."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_robot(mounted.path)
    bank = SceneBank.open("mini")
    for scene in (bank[0], bank[-1]):
        checker = CollisionChecker(planning_model(compile_scene(scene, mounted), 0))
        assert checker.contacts(mounted.start) == []


def test_a_mounted_arm_carries_the_tool_of_the_shipped_arms(mounted: Robot) -> None:
    model, own = mounted.spec().compile(), get_robot("ur5e").spec().compile()
    for name in ("rod", "cup"):
        np.testing.assert_allclose(model.geom(name).size, own.geom(name).size, atol=1e-5)
        assert model.geom(name).contype == own.geom(name).contype
        assert model.geom(name).conaffinity == own.geom(name).conaffinity
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    tip, cup = model.site("tip").id, model.geom("cup").id
    axis = data.site_xmat[tip].reshape(3, 3)[:, 2]
    np.testing.assert_allclose(data.site_xpos[tip] - data.geom_xpos[cup], 0.02 * axis, atol=1e-5)
    assert all(model.geom(i).name for i in range(model.ngeom))


def test_a_mounted_arm_reaches_and_is_driven_there(mounted: Robot, bank: SceneBank) -> None:
    agent = PlannerAgent("RRTConnect", time_limit=60.0, max_checks=20_000, goals=20)
    result = evaluate(
        agent, split="test", bank=bank, robot=mounted, problems=[("made-up-0", 1), ("made-up-1", 4)], progress=False
    )
    assert [record.status for record in result.records] == ["solved", "solved"]
    assert result.success_rate == 1.0


@pytest.mark.parametrize("action", ["joint", "joint_velocity", "tip_velocity"])
def test_all_actions_keep_the_limits_of_a_mounted_arm(mounted: Robot, action: str, bank: SceneBank) -> None:
    env = GreenhouseVectorEnv(3, bank=bank, robot=mounted, action=action)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(12):
        before = env.simulation.command.copy()
        observation, *_ = env.step(rng.uniform(-1, 1, (3, env.single_action_space.shape[0])).astype(np.float32))
        assert np.isfinite(observation).all()
        after = env.simulation.command
        assert ((after >= mounted.lower - 1e-9) & (after <= mounted.upper + 1e-9)).all()
        assert (np.abs(after - before) <= mounted.velocity_limits * 0.05 + 0.2).all()
    env.close()


@pytest.mark.parametrize("name", ["fr3", "xarm7"])
def test_the_flange_of_an_arm_without_a_cup_may_touch_the_target(name: str, tmp_path: Path) -> None:
    robot = load_robot(write_arm(name, tmp_path), start="upright")
    scene = make_scene(0)
    found = [len(goal_configurations(scene, k, robot, count=3).configurations) for k in (1, 4, 7, 10)]
    assert sum(count > 0 for count in found) >= 2


def test_a_home_among_the_plants_is_warned_of(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"fr3\.xml: at its start the arm reaches 0\.5\d m ahead.*ready"):
        load_robot(write_arm("fr3", tmp_path))


def test_the_cart_keeps_below_a_shoulder_that_reaches_down(tmp_path: Path) -> None:
    robot = load_robot(write_arm("ur10e", tmp_path), start="upright")
    assert robot.foot == pytest.approx(0.027)
    model = compile_scene(make_scene(0), robot).model
    top = model.geom("cart").pos[2] + model.geom("cart").size[2]
    base = model.body("base").pos[2]
    assert base - robot.foot - top == pytest.approx(0.02)
    # and where the arm does not reach down, the cart's top is where it always was
    model = compile_scene(make_scene(0), "ur5e").model
    assert model.body("base").pos[2] - model.geom("cart").pos[2] - model.geom("cart").size[2] == pytest.approx(0.03)


def test_a_base_turned_in_its_file_stays_turned(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="ahead of its base"):
        robot = load_robot(write_arm("ur10e", tmp_path))
    model = compile_scene(make_scene(0), robot).model
    data = mujoco.MjData(model)
    data.qpos[:] = robot.start
    mujoco.mj_kinematics(model, data)
    assert data.site("tip").xpos[0] > 0.5  # its home looks ahead, not along the row


@pytest.mark.parametrize("name", ["ur10e", "xarm7", "rail_arm"])
def test_a_ready_start_is_found_for_any_arm(name: str, tmp_path: Path) -> None:
    robot = load_robot(write_arm(name, tmp_path), start="ready")
    model = robot.spec().compile()
    axis = tool_state(tool_chain(model, model.site("tip").id), robot.start[None]).axis[0]
    assert axis[0] > 0.8  # forward
    assert 0.1 < ahead_of_base(model, robot.start) < 0.3
    assert robot.rating_start is robot.upright_start is robot.start  # it has no other
    np.testing.assert_array_equal(load_robot(robot.path, start="ready").start, robot.start)


def test_default_speeds_are_those_that_the_servos_attain(tmp_path: Path) -> None:
    robot = load_robot(write_arm("ur10e", tmp_path), start="upright")
    np.testing.assert_allclose(robot.velocity_limits, 0.8 * 330 / 300)


def test_joints_without_limits_get_one_turn_around_the_start(tmp_path: Path) -> None:
    robot = load_robot(write_arm("gen3", tmp_path), start=[0.5, 0, 0, -1.0, 0, 0, 0])
    np.testing.assert_allclose(robot.lower[0], 0.5 - np.pi)
    np.testing.assert_allclose(robot.upper[0], 0.5 + np.pi)
    np.testing.assert_allclose([robot.lower[1], robot.upper[1]], [-2.24, 2.24])


def test_a_slide_has_limits_and_speeds_in_metres(tmp_path: Path) -> None:
    file = write_arm("rail_arm", tmp_path)
    robot = load_robot(file)
    assert robot.sliding.tolist() == [True, True, False, False, False, False]
    np.testing.assert_allclose(robot.velocity_limits, [0.4, 0.4, 1.6, 1.6, 1.6, 1.6])
    np.testing.assert_allclose(robot.acceleration_limits, [2, 2, 10, 10, 10, 10])
    assert robot.shoulder_height == pytest.approx(0.13 + 0.1 + 0.16 + 0.1)  # with the lift where it starts
    file.write_text(file.read_text().replace(' range="0.0 0.4"', ""))
    with pytest.raises(FileFormatError, match="slide joint 'joint2' has no limits"):
        load_robot(file)


def test_reaches_bound_what_a_motion_of_slides_and_hinges_moves(tmp_path: Path) -> None:
    robot = load_robot(write_arm("rail_arm", tmp_path))
    model = compile_scene(make_scene(0), robot).model
    reaches = CollisionChecker(model).reaches
    np.testing.assert_allclose(reaches[:2], 1.0)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    moving = np.flatnonzero(model.geom_bodyid > 0)

    def ends(q: np.ndarray) -> np.ndarray:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        along = model.geom_size[moving, 1, None] * data.geom_xmat[moving].reshape(-1, 3, 3)[:, :, 2]
        return np.concatenate([data.geom_xpos[moving] + along, data.geom_xpos[moving] - along])

    for _ in range(300):
        q = rng.uniform(robot.lower, robot.upper)
        step = 0.01 * rng.standard_normal(6)
        moved = np.linalg.norm(ends(q + step) - ends(q), axis=-1).max()
        assert moved <= reaches @ np.abs(step) + 1e-9
        assert moved > 0.02 * reaches @ np.abs(step)


def test_clearance_along_a_rail_is_that_of_the_arm(tmp_path: Path) -> None:
    robot = load_robot(write_arm("rail_arm", tmp_path))
    compiled = compile_scene(make_scene(0), robot)
    away = robot.start + [0.2, 0.1, 0, 0, 0, 0]
    assert 0 < path_clearance(compiled, 0, [robot.start, away]) <= 0.1


# -- masks, names, copies ---------------------------------------------------------------------------------------------


def _shipped(tmp_path: Path, old: str, new: str) -> Path:
    text = ROBOTS["ur5e"].read_text()
    assert old in text
    file = tmp_path / "ur5e.xml"
    file.write_text(text.replace(old, new))
    return file


def test_masks_of_ones_own_do_not_let_an_arm_through_the_plants(tmp_path: Path) -> None:
    file = _shipped(tmp_path, 'contype="1" conaffinity="3"', 'contype="4" conaffinity="4"')
    scene = make_scene(0)
    own, other = (CollisionChecker(planning_model(compile_scene(scene, r), 0)) for r in ("ur5e", load_robot(file)))
    robot, rng = get_robot("ur5e"), np.random.default_rng(0)
    verdicts = [(own.is_free(q), other.is_free(q)) for q in rng.uniform(robot.lower, robot.upper, (300, 6))]
    assert {a for a, _ in verdicts} == {True, False}
    assert all(a == b for a, b in verdicts)


def test_a_cup_needs_no_masks(tmp_path: Path) -> None:
    file = _shipped(tmp_path, 'contype="2" conaffinity="2"', "")
    model = load_robot(file).spec().compile()
    assert (int(model.geom("cup").contype[0]), int(model.geom("cup").conaffinity[0])) == (2, 2)


def test_an_arm_on_which_nothing_collides_is_refused(tmp_path: Path) -> None:
    text = ROBOTS["ur5e"].read_text()
    text = text.replace('contype="1" conaffinity="3"', 'contype="0" conaffinity="0"')
    file = tmp_path / "ghost.xml"
    file.write_text(text.replace('contype="2" conaffinity="2"', 'contype="0" conaffinity="0"'))
    with pytest.raises(FileFormatError, match=r"ghost\.xml: none of its geoms collides"):
        load_robot(file)


def test_an_arm_that_touches_itself_at_its_start_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="at its start it touches itself, or nearly: '"):
        load_robot(ROBOTS["ur5e"], start=[0, -1.57, 2.9, 0, 0, 0])


def test_an_edited_file_is_read_again(tmp_path: Path) -> None:
    file = _shipped(tmp_path, "<mujoco", "<mujoco")
    first = get_robot(file)
    assert get_robot(file) is first
    text = file.read_text()
    file.write_text(text.replace('data="3.14159 3.14159', 'data="1.0 3.14159'))
    second = get_robot(file)
    assert (first.velocity_limits[0], second.velocity_limits[0]) == (3.14159, 1.0)
    file.write_text(text.replace('name="rod" size="0.012"', 'name="rod" size="0.05"'))
    assert float(second.spec().compile().geom("rod").size[0]) == 0.012  # what it was read with
    (tmp_path / "whole.xml").write_text('<mujoco><include file="ur5e.xml"/></mujoco>')
    whole = get_robot(tmp_path / "whole.xml")
    file.write_text(text)
    assert get_robot(tmp_path / "whole.xml") is not whole


def test_robots_travel_between_processes(tmp_path: Path) -> None:
    robot = load_robot(write_arm("fr3", tmp_path), start="upright", velocity_limits=np.arange(1.0, 8.0))
    assert copy.deepcopy(robot) is robot
    other = pickle.loads(pickle.dumps(robot))
    np.testing.assert_array_equal(other.start, robot.start)
    np.testing.assert_array_equal(other.velocity_limits, robot.velocity_limits)
    assert other.spec().compile().ngeom == robot.spec().compile().ngeom


def test_a_tool_is_mounted_once(tmp_path: Path) -> None:
    out = mount_tool(write_arm("fr3", tmp_path), tmp_path / "out.xml")
    with pytest.raises(FileFormatError, match="already has a tool"):
        mount_tool(out, tmp_path / "twice.xml")
    with pytest.raises(FileFormatError, match="'nose'; it has attachment_site"):
        mount_tool(tmp_path / "fr3.xml", tmp_path / "twice.xml", flange="nose")
    with pytest.raises(InvalidValueError, match="the copy needs another file"):
        mount_tool(tmp_path / "fr3.xml", tmp_path / "fr3.xml")


def test_many_loaded_robots_do_not_pile_up(tmp_path: Path, bank: SceneBank) -> None:
    from greenhouse_gym.envs.worlds import shared_worlds

    for _ in range(12):
        GreenhouseEnv(bank=bank, robot=load_robot(ROBOTS["ur5e"])).close()
    assert shared_worlds.cache_info().currsize <= 8


# -- MuJoCo Menagerie's own arms, where they have been downloaded -----------------------------------------------------

MENAGERIE = {
    "franka_fr3": "fr3",
    "ufactory_xarm7": "xarm7_nohand",
    "universal_robots_ur10e": "ur10e",
    "kinova_gen3": "gen3",
}


@pytest.mark.parametrize("name", sorted(MENAGERIE))
def test_an_arm_of_mujoco_menagerie(
    name: str, tmp_path: Path, bank: SceneBank, monkeypatch: pytest.MonkeyPatch
) -> None:
    if find_spec("mujoco_menagerie") is None:
        pytest.skip("needs the package mujoco-menagerie")
    import mujoco_menagerie

    monkeypatch.setenv("MENAGERIE_BASE_URL", "file:///nowhere")  # what is not here already is not downloaded
    try:
        file = mujoco_menagerie.get(name).xml(MENAGERIE[name])
    except mujoco_menagerie.DownloadError:
        pytest.skip(f"{name} has not been downloaded to this machine")
    robot = get_robot(mount_tool(file, tmp_path / "arm.xml"))
    agent = PlannerAgent("RRTConnect", time_limit=60.0, max_checks=20_000, goals=20)
    assert evaluate(agent, bank=bank, robot=robot, problems=[("made-up-0", 1)], progress=False).success_rate == 1.0
