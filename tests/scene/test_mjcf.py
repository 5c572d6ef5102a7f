from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.geometry import Box, Capsule, Ellipsoid, Sphere, rotation_about
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import ArmPlacement, Provenance, Scene, compile_scene, scene_spec
from greenhouse_gym.scene.mjcf import ARM_AND_CUP, ARM_ONLY


@pytest.fixture(scope="module")
def mixed() -> Scene:
    turn = rotation_about([1.0, 2.0, 3.0], 0.8)
    return Scene(
        name="a 'mixed' & scene",
        tomatoes=(
            Tomato(Sphere([0.5, -0.4, 0.9], 0.03), truss=0),
            Tomato(Sphere([0.5, 0.4, 0.9], 0.025), truss=1, ripeness=0.2),
        ),
        stems=(
            Stem([0.6, 0, 0.5], [0.65, 0.1, 2.0], 0.006, kind="main"),
            Stem([0, 1, 1], [0, 1, 1], 0.02, kind="pipe"),
        ),
        clutter=(
            Box([0.6, 0.3, 1.4], [0.1, 0.05, 0.002], turn),
            Capsule([1, 1, 1], [1, 1.2, 1], 0.01),
            Sphere([1, 0, 2], 0.1),
        ),
        placement=ArmPlacement(position=[0.05, 0.1, 0.0], yaw=0.3, shoulder_height=1.2),
        provenance=Provenance(row="r"),
    )


def obstacles(model: mujoco.MjModel, count: int) -> list[int]:
    return [i for i in range(model.ngeom) if model.geom(i).name.startswith(("tomato_", "stem_", "clutter_"))][:count]


@pytest.mark.parametrize("robot", [None, "ur5e"])
def test_the_xml_opens_in_plain_mujoco_with_the_same_geoms(mixed: Scene, robot: str | None) -> None:
    model = mujoco.MjModel.from_xml_string(mixed.to_mjcf(robot))
    direct = scene_spec(mixed, robot).compile()
    assert [model.geom(i).name for i in range(model.ngeom)] == [direct.geom(i).name for i in range(direct.ngeom)]
    np.testing.assert_array_equal(model.geom_type, direct.geom_type)
    np.testing.assert_array_equal(model.geom_contype, direct.geom_contype)
    np.testing.assert_array_equal(model.geom_conaffinity, direct.geom_conaffinity)
    poses = []
    for each in (model, direct):
        data = mujoco.MjData(each)
        mujoco.mj_forward(each, data)
        poses.append((each.geom_size, data.geom_xpos, data.geom_xmat))
    for a, b in zip(*poses, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)  # MuJoCo writes six digits
    assert (model.nu, model.nkey) == ((0, 0) if robot is None else (6, direct.nkey))
    assert model.opt.timestep == direct.opt.timestep == 0.01
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def test_obstacles_are_geoms_of_the_world_in_the_scenes_order(mixed: Scene) -> None:
    compiled = compile_scene(mixed, "ur5e")
    model, geoms = compiled.model, range(compiled.obstacle_geoms.start, compiled.obstacle_geoms.stop)
    names = [model.geom(i).name for i in geoms]
    assert names == ["tomato_0", "tomato_1", "stem_0_main", "stem_1_pipe", "clutter_0", "clutter_1", "clutter_2"]
    assert (model.geom_bodyid[list(geoms)] == 0).all()
    assert compiled.tomato_geom(1) == model.geom("tomato_1").id
    sphere, box = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_BOX
    assert model.geom("stem_1_pipe").type == sphere  # a capsule without length
    np.testing.assert_allclose(model.geom("tomato_0").pos, mixed.tomatoes[0].center)
    assert model.geom("tomato_0").size[0] == mixed.tomatoes[0].radius
    leaf = mixed.clutter[0]
    assert isinstance(leaf, Box)
    assert model.geom("clutter_0").type == box
    np.testing.assert_allclose(model.geom("clutter_0").size, leaf.half_extents)
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.geom("clutter_0").quat)
    np.testing.assert_allclose(turn.reshape(3, 3), leaf.rotation, atol=1e-9)


def test_the_arm_stands_where_the_scene_says(mixed: Scene) -> None:
    robot = get_robot("ur5e")
    compiled = compile_scene(mixed, robot)
    data = mujoco.MjData(compiled.model)
    mujoco.mj_resetDataKeyframe(compiled.model, data, 0)
    mujoco.mj_forward(compiled.model, data)
    np.testing.assert_allclose(data.body("shoulder").xpos, [0.05, 0.1, 1.2], atol=1e-12)
    x_axis = data.body("base").xmat.reshape(3, 3)[:, 0]
    np.testing.assert_allclose(x_axis, [np.cos(0.3), np.sin(0.3), 0.0], atol=1e-12)
    assert data.ncon == 0
    cart = data.geom("cart").xpos, compiled.model.geom("cart").size
    assert cart[0][2] - cart[1][2] == pytest.approx(0.0)
    np.testing.assert_allclose(data.qpos, robot.start)


def test_a_low_stand_has_no_cart(mixed: Scene) -> None:
    low = mixed.model_copy(update={"placement": ArmPlacement(shoulder_height=get_robot("ur5e").shoulder_height + 0.02)})
    compiled = compile_scene(low)
    assert mujoco.mj_name2id(compiled.model, mujoco.mjtObj.mjOBJ_GEOM, "cart") == -1
    assert compiled.model.geom(compiled.obstacle_geoms.start).name == "tomato_0"


def test_padding_gives_every_scene_one_size_and_parks_the_rest(mixed: Scene) -> None:
    padded, plain = compile_scene(mixed, capacity=40), compile_scene(mixed)
    assert padded.obstacle_geoms.stop - padded.obstacle_geoms.start == 40
    assert padded.model.ngeom == plain.model.ngeom + 33
    data = mujoco.MjData(padded.model)
    mujoco.mj_forward(padded.model, data)
    parked = np.arange(padded.obstacle_geoms.start + 7, padded.obstacle_geoms.stop)
    assert (data.geom_xpos[parked, 2] < -10).all()
    assert padded.cup_geom == padded.model.geom("cup").id
    with pytest.raises(InvalidValueError, match=r"has 7 obstacles, more than the 6 allowed"):
        compile_scene(mixed, capacity=6)
    assert compile_scene(mixed, capacity=7).model.ngeom == plain.model.ngeom


def test_only_the_cup_may_touch_the_target() -> None:
    """The masks of target, obstacle, rod and cup, put to the test with the tool in the middle of a tomato."""
    compiled = compile_scene(Scene(name="s", provenance=Provenance(row="r")))
    data = mujoco.MjData(compiled.model)
    mujoco.mj_resetDataKeyframe(compiled.model, data, 0)
    mujoco.mj_forward(compiled.model, data)
    for part, center in (("cup", data.geom("cup").xpos), ("rod", data.geom("rod").xpos)):
        touching = Scene(name="t", tomatoes=(Tomato(Sphere(center, 0.014), truss=0),), provenance=Provenance(row="r"))
        own = compile_scene(touching)
        for allowed, expected in ((False, True), (True, part == "rod"), (False, True)):
            own.allow_cup_on(own.model, 0, allowed)
            assert own.model.geom("tomato_0").contype == (ARM_ONLY if allowed else ARM_AND_CUP)
            state = mujoco.MjData(own.model)
            mujoco.mj_resetDataKeyframe(own.model, state, 0)
            mujoco.mj_forward(own.model, state)
            names = {own.model.geom(int(g)).name for g in state.contact.geom.ravel()}
            assert (part in names) == expected


def test_an_unknown_robot_is_named(mixed: Scene) -> None:
    with pytest.raises(UnknownNameError, match="ur10"):
        mixed.to_mjcf("ur10")


def test_an_ellipsoid_stands_as_the_scene_says() -> None:
    turn = rotation_about([1.0, 2.0, 3.0], 0.8)
    tomato = Tomato(Ellipsoid([0.5, 0.1, 1.0], [0.025, 0.03, 0.036], turn), truss=0)
    model = scene_spec(Scene(name="one", tomatoes=(tomato,), provenance=Provenance(row="r"))).compile()
    geom = model.geom("tomato_0")
    assert geom.type == mujoco.mjtGeom.mjGEOM_ELLIPSOID
    np.testing.assert_allclose(geom.size, [0.025, 0.03, 0.036])
    found = np.empty(9)
    mujoco.mju_quat2Mat(found, geom.quat)
    np.testing.assert_allclose(found.reshape(3, 3), turn, atol=1e-9)


def test_a_replay_in_plain_mujoco_judges_as_the_environment_does(mixed: Scene) -> None:
    target = 1
    compiled = compile_scene(mixed, "ur5e")
    judging = copy.copy(compiled.model)
    compiled.allow_cup_on(judging, target)
    plain = mujoco.MjModel.from_xml_string(mixed.to_mjcf("ur5e", target=target))
    for mask in ("geom_contype", "geom_conaffinity"):
        np.testing.assert_array_equal(getattr(plain, mask), getattr(judging, mask))
    with pytest.raises(InvalidValueError, match=r"has tomatoes 0 to \d+, there is no 99"):
        mixed.to_mjcf("ur5e", target=99)
