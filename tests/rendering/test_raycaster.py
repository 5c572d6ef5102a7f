from __future__ import annotations

import mujoco
import numpy as np
import pytest

from greenhouse_gym.envs.worlds import shared_worlds
from greenhouse_gym.geometry import rotation_about
from greenhouse_gym.rendering.ray_kernels import nearer_hits
from greenhouse_gym.rendering.raycaster import RayCaster
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import SceneBank


@pytest.mark.parametrize("robot", ["ur5e", "iiwa14"])
def test_what_is_left_out_is_not_seen(bank: SceneBank, robot: str) -> None:
    """The same hits as with all geoms, from cameras anywhere, one after the other with the same caster."""
    arm = get_robot(robot)
    worlds = shared_worlds(arm, "reconstruction", 300)
    scenes = [bank.scene(name) for split in ("train", "test") for name in bank.names(split)]
    caster = RayCaster(worlds.world(scenes[0]).compiled)
    random = np.random.default_rng(0)
    spread = np.stack(np.meshgrid(*[np.linspace(-0.6, 0.6, 24)] * 2, [1.0]), axis=-1).reshape(-1, 3)
    spread /= np.linalg.norm(spread, axis=1, keepdims=True)
    hits, on_the_arm = 0, 0
    for k in range(24):
        world = worlds.world(scenes[k % len(scenes)])
        model = world.compiled.model
        data = mujoco.MjData(model)
        data.qpos[:] = random.uniform(arm.lower, arm.upper)
        mujoco.mj_kinematics(model, data)
        origin = world.frame[:3] + random.uniform([-0.3, -0.5, -0.3], [0.7, 0.5, 0.6])
        directions = spread @ rotation_about(random.normal(size=3), random.uniform(0, 3)).T
        geom, expected = np.empty(len(spread), dtype=np.int32), np.empty(len(spread))
        normals = np.zeros((len(spread), 3))
        mujoco.mj_multiRay(
            model, data, origin, directions.reshape(-1), None, True, -1, geom, expected, normals.reshape(-1),
            len(spread), 2.0,
        )  # fmt: skip
        distance, found, rgba, normal = caster.cast(model, data.qpos, origin, directions, 2.0, surfaces=True)
        there = expected >= 0
        np.testing.assert_array_equal(normal[there], normals[there])
        np.testing.assert_array_equal(rgba[there], model.geom_rgba[geom[there]])
        np.testing.assert_array_equal(distance, expected)
        np.testing.assert_array_equal(found, geom)
        arm_hit = (geom >= 0) & (model.geom_bodyid[geom] > 0)
        hits, on_the_arm = hits + (distance >= 0).sum(), on_the_arm + arm_hit.sum()
    assert hits > 1000
    assert on_the_arm > 20


@pytest.mark.parametrize("reach", [0.4, 5.0])
def test_hits_on_shapes_of_all_kinds_are_those_of_mujoco(reach: float) -> None:
    """Among shapes that overlap, are turned, invisible, or contain the origin of the rays."""
    rng, spec = np.random.default_rng(0), mujoco.MjSpec()
    names = ("SPHERE", "CAPSULE", "ELLIPSOID", "BOX")
    kinds = [getattr(mujoco.mjtGeom, f"mjGEOM_{name}") for name in names]
    for k in range(80):
        spec.worldbody.add_geom(
            type=kinds[k % 4], size=rng.uniform(0.01, 0.3, 3), pos=rng.normal(0, 0.5, 3), quat=rng.normal(size=4),
            rgba=[1, 1, 1, float(k % 7 > 0)],
        )  # fmt: skip
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geoms = (model.geom_type, model.geom_size, model.geom_pos, model.geom_quat, model.geom_rbound, model.geom_rgba)
    tree = model.bvh_child, model.bvh_nodeid, model.bvh_aabb
    directions = np.concatenate([rng.normal(size=(300, 3)), np.eye(3), -np.eye(3)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    count, seen = len(directions), set()
    for origin in np.concatenate([rng.normal(0, 0.5, (20, 3)), model.geom_pos[:4]]):
        geom, expected, normals = np.empty(count, np.int32), np.empty(count), np.zeros((count, 3))
        mujoco.mj_multiRay(
            model,
            data,
            origin,
            directions.reshape(-1),
            None,
            True,
            -1,
            geom,
            expected,
            normals.reshape(-1),
            count,
            reach,
        )
        distance, hit, normal = np.full(count, -1.0), np.full(count, -1), np.zeros((count, 3))
        nearer_hits(
            origin, directions, np.arange(len(directions)), reach, 0, model.ngeom, geoms, tree, distance, hit, normal
        )
        np.testing.assert_array_equal(hit, geom)
        np.testing.assert_array_equal(distance, expected)
        np.testing.assert_array_equal(normal[hit >= 0], normals[hit >= 0])
        seen |= set(model.geom_type[hit[hit >= 0]].tolist())
    assert len(seen) == 4
