from __future__ import annotations

import copy
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from greenhouse_gym.robots import ROBOTS
from greenhouse_gym.scene import SceneBank, compile_scene
from greenhouse_gym.scene.geom_order import (
    ShortGeomLists,
    _geom_count,
    compiled_geom_id,
    first_world_geom,
    index_of_geom_count,
    put_arm_first,
)
from greenhouse_gym.scene.truth import true_scene

WITH_ARM = "<body><joint axis='0 0 1'/><geom name='link' size='0.2' pos='1 0 0'/></body>"


def contacts(model: mujoco.MjModel, joints: np.ndarray) -> list[tuple[int, int, float]]:
    data = mujoco.MjData(model)
    data.qpos[:] = joints
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    pairs = [sorted(compiled_geom_id(model, geom) for geom in pair) for pair in data.contact.geom.tolist()]
    return sorted((a, b, dist) for (a, b), dist in zip(pairs, data.contact.dist.tolist(), strict=True))


@pytest.mark.parametrize("robot", sorted(ROBOTS))
def test_the_same_touches_in_either_order(robot: str) -> None:
    bank, random, touches = SceneBank.open("mini"), np.random.default_rng(0), 0
    for name in bank.names()[:2]:
        compiled = compile_scene(true_scene(bank.scene(name)), robot)
        reordered = copy.copy(compiled.model)
        put_arm_first(reordered)
        assert 0 < first_world_geom(reordered) < 40
        for _ in range(60):
            joints = random.uniform(compiled.robot.lower, compiled.robot.upper)
            expected = contacts(compiled.model, joints)
            assert contacts(reordered, joints) == expected
            touches += len(expected)
    assert touches > 500


def test_within_the_block_a_model_tells_of_the_arm_alone(bank: SceneBank) -> None:
    model = copy.copy(compile_scene(bank.scene(bank.names("train")[0])).model)
    arm, world, count = int((model.geom_bodyid > 0).sum()), int(model.body_geomnum[0]), model.ngeom
    with ShortGeomLists([model]):
        assert (model.ngeom, int(model.body_geomnum[0])) == (count, 2), "in its first order all geoms are gone through"
    put_arm_first(model)
    with ShortGeomLists([model]):
        assert (model.ngeom, int(model.body_geomnum[0])) == (arm, 2)
    assert (model.ngeom, int(model.body_geomnum[0])) == (count, world)


def test_the_list_is_long_enough_for_what_any_geom_of_the_world_may_touch() -> None:
    """A robot's file may begin with geoms of the world that touch nothing."""
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{WITH_ARM}</worldbody></mujoco>")
    for contype, conaffinity in ((0, 0), (1, 0), (1, 1), (3, 1), (1, 3), (3, 3)):
        spec.worldbody.add_geom(size=[0.1, 0, 0], contype=contype, conaffinity=conaffinity)
    model = spec.compile()
    put_arm_first(model)
    with ShortGeomLists([model]):
        assert model.body_geomnum[0] == 5
    assert model.body_geomnum[0] == 6


@pytest.mark.parametrize(
    "extra",
    [
        "<contact><pair geom1='link' geom2='wall'/></contact>",
        "<sensor><user dim='1' objtype='geom' objname='wall'/></sensor>",
        "<tendon><spatial><site site='a'/><geom geom='wall'/><site site='b'/></spatial></tendon>",
    ],
)
def test_a_model_that_tells_of_geoms_otherwise_stays_as_it_is(extra: str) -> None:
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody><geom name='wall' size='0.1'/><site name='a' pos='2 0 0'/><site name='b' pos='-2 0 0'/>"
        f"{WITH_ARM}</worldbody>{extra}</mujoco>"
    )
    before = model.geom_pos.copy()
    put_arm_first(model)
    np.testing.assert_array_equal(model.geom_pos, before)
    assert first_world_geom(model) == 0
    with ShortGeomLists([model]):
        assert model.ngeom == 2


def test_sizes_that_lie_elsewhere_in_memory_are_left_alone() -> None:
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody><geom size='1'/>{WITH_ARM}</worldbody></mujoco>")
    count = _geom_count(model)
    assert count is not None, "this version of MuJoCo keeps its sizes where they are looked for"
    assert count.tolist() == [2]
    sizes = {name: getattr(model, name) for name in model._size_fields}
    turned = SimpleNamespace(**sizes, _size_fields=model._size_fields[::-1], _address=model._address)
    assert index_of_geom_count(model) == model._size_fields.index("ngeom")
    assert index_of_geom_count(turned) is None
    assert index_of_geom_count(SimpleNamespace(ngeom=2)) is None
