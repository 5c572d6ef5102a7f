from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest
from conftest import with_ellipsoids

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.motion.clearance import CLEARANCE_RANGE, path_clearance
from greenhouse_gym.motion.collision import (
    MARGIN,
    PROOF,
    CollisionChecker,
    halving_order,
    planning_model,
    set_margin,
)
from greenhouse_gym.motion.joint_reaches import arm_reaches, joint_reaches
from greenhouse_gym.motion.path import along_path
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene

TARGET = 4


@pytest.fixture(scope="module")
def compiled(scene: Scene) -> CompiledScene:
    return compile_scene(scene)


@pytest.fixture(scope="module")
def configurations(compiled: CompiledScene) -> np.ndarray:
    return np.random.default_rng(0).uniform(compiled.robot.lower, compiled.robot.upper, (2000, 6))


def test_verdicts_are_the_simulators(compiled: CompiledScene, configurations: np.ndarray) -> None:
    """A padded model that is stepped by MuJoCo's own pipeline, and the checker without a margin."""
    padded = compile_scene(compiled.scene, capacity=100)
    padded.allow_cup_on(padded.model, TARGET)
    data = mujoco.MjData(padded.model)
    checker = CollisionChecker(planning_model(compiled, TARGET, margin=0.0))
    free = 0
    for q in configurations:
        data.qpos[:] = q
        mujoco.mj_forward(padded.model, data)
        assert checker.is_free(q) == (data.ncon == 0)
        free += data.ncon == 0
    assert 0.2 < free / len(configurations) < 0.8
    assert checker.checks == len(configurations)


@pytest.mark.parametrize("robot", ["ur5e", "iiwa14"])
def test_a_world_at_rest_has_the_same_contacts(scene: Scene, robot: str) -> None:
    compiled = compile_scene(scene, robot)
    still = planning_model(compiled, TARGET)
    placed = copy.copy(still)
    placed.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    assert placed.opt.enableflags != still.opt.enableflags
    data, again = mujoco.MjData(still), mujoco.MjData(placed)
    touching = 0
    for q in np.random.default_rng(4).uniform(compiled.robot.lower, compiled.robot.upper, (1500, still.nq)):
        for model, one in ((still, data), (placed, again)):
            one.qpos[:] = q
            mujoco.mj_kinematics(model, one)
            mujoco.mj_collision(model, one)
        assert np.array_equal(data.contact.geom, again.contact.geom)
        assert np.array_equal(data.contact.dist, again.contact.dist)
        touching += data.ncon > 0
    assert 200 < touching < 1300


def test_free_means_the_margin_is_kept(compiled: CompiledScene, configurations: np.ndarray) -> None:
    """Against distances of all pairs: the pair search must honor the margin."""
    model = planning_model(compiled, TARGET)
    checker, data = CollisionChecker(model), mujoco.MjData(model)
    arm = [g for g in range(model.ngeom) if model.geom_bodyid[g] > 0 and model.geom(g).name != "base"]
    world = [g for g in range(model.ngeom) if model.geom_bodyid[g] == 0]
    pairs = [(a, w) for a in arm for w in world if model.geom(w).name not in ("floor", f"tomato_{TARGET}")]
    near = 0
    for q in configurations[:600]:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        distance = min(mujoco.mj_geomDistance(model, data, a, w, 0.5, None) for a, w in pairs)
        if checker.is_free(q):
            assert distance >= MARGIN - 1e-6
        near += 0 < distance < MARGIN
    assert near > 0


def test_the_margin_is_kept_from_ellipsoids_too(scene: Scene) -> None:
    compiled = compile_scene(with_ellipsoids(scene, 0))
    model, data = compiled.model, mujoco.MjData(compiled.model)
    ellipsoids = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_ELLIPSOID)
    assert len(ellipsoids) == 6
    alone = planning_model(compiled, TARGET, pairs=("tomatoes",))
    balls = np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE) & (model.geom_bodyid == 0))
    alone.geom_contype[balls] = alone.geom_conaffinity[balls] = 0
    checker, fromto, near = CollisionChecker(alone), np.empty(6), 0
    arm = [g for g in np.flatnonzero(model.geom_bodyid > 0) if model.geom_contype[g] | model.geom_conaffinity[g]]
    for q in np.random.default_rng(3).uniform(compiled.robot.lower, compiled.robot.upper, (1500, 6)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        gap = min(
            mujoco.mj_geomDistance(model, data, int(e), int(g), 0.05, fromto)
            for e in ellipsoids
            for g in arm
            if not (e == compiled.tomato_geom(TARGET) and g == compiled.cup_geom)
        )
        if abs(gap - MARGIN) > 1e-4:
            assert checker.is_free(q) == (gap > MARGIN), gap
        near += gap < 0.02
    assert near > 15


def test_clearance_is_the_distance_of_all_pairs(compiled: CompiledScene) -> None:
    model = planning_model(compiled, TARGET, margin=0.0)
    obstacles = np.arange(compiled.obstacle_geoms.start, compiled.obstacle_geoms.stop)
    set_margin(model, obstacles, 0.2)
    checker, data = CollisionChecker(model), mujoco.MjData(model)
    arm = [g for g in range(model.ngeom) if model.geom_bodyid[g] > 0]
    cup, target = compiled.cup_geom, compiled.tomato_geom(TARGET)
    pairs = [(a, int(o)) for a in arm for o in obstacles if (a, o) != (cup, target)]
    start = compiled.robot.upright_start
    compared = 0
    for q in start + np.random.default_rng(1).uniform(-1, 1, (60, 6)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        distance = min(mujoco.mj_geomDistance(model, data, a, o, 1.0, None) for a, o in pairs)
        names = [sorted(model.geom_bodyid[list(pair)]) for pair in data.contact.geom]
        if 0 < distance < 0.2 and all(low == 0 for low, _ in names) and checker.clearance(q) > 0:
            assert checker.clearance(q) == pytest.approx(distance, abs=1e-6)
            compared += 1
    assert compared > 5
    assert checker.clearance(start) == np.inf


def test_only_the_cup_may_touch_and_only_the_target(compiled: CompiledScene) -> None:
    model = planning_model(compiled, TARGET, margin=0.0)
    target, other = compiled.tomato_geom(TARGET), compiled.tomato_geom(TARGET + 1)
    rod = model.geom("rod").id

    def touch(a: int, b: int) -> bool:
        return bool(
            model.geom_contype[a] & model.geom_conaffinity[b] or model.geom_contype[b] & model.geom_conaffinity[a]
        )

    assert not touch(compiled.cup_geom, target)
    assert touch(rod, target)
    assert touch(compiled.cup_geom, other)
    assert touch(compiled.cup_geom, compiled.model.geom("floor").id)
    assert compiled.model.geom_contype[target] == 3, "the shared model was changed"


def test_no_point_moves_farther_than_the_reaches_say(compiled: CompiledScene, configurations: np.ndarray) -> None:
    model, data = compiled.model, mujoco.MjData(compiled.model)
    arm = np.flatnonzero(model.geom_bodyid > 0)
    reaches = joint_reaches(model)
    rng = np.random.default_rng(2)
    tightest = 0.0
    for q in configurations[:300]:
        step = 1e-3 * rng.normal(size=6)
        places = []
        for configuration in (q, q + step):
            data.qpos[:] = configuration
            mujoco.mj_kinematics(model, data)
            along = data.geom_xmat[arm].reshape(-1, 3, 3)[:, :, 2] * model.geom_size[arm, 1, None]
            places.append(np.concatenate([data.geom_xpos[arm] + along, data.geom_xpos[arm] - along]))
        moved = np.linalg.norm(places[1] - places[0], axis=-1).max()
        assert moved <= reaches @ np.abs(step) + 1e-9
        tightest = max(tightest, moved / (reaches @ np.abs(step)))
    assert tightest > 0.4
    assert 1.2 < reaches[0] < 1.6


def test_motions_are_checked_finely_enough_and_alike_in_both_directions(compiled: CompiledScene) -> None:
    proof = CollisionChecker(planning_model(compiled, TARGET))
    simulator = CollisionChecker(planning_model(compiled, TARGET, margin=0.0))
    rng, start = np.random.default_rng(3), compiled.robot.start
    verdicts = []
    for _ in range(40):
        end = start + rng.uniform(-1.5, 1.5, 6).clip(compiled.robot.lower - start, compiled.robot.upper - start)
        free = proof.motion_is_free(start, end, PROOF)
        assert free == proof.motion_is_free(end, start, PROOF)
        verdicts.append(free)
        if free:  # then the simulator finds nothing, however closely it looks
            assert all(map(simulator.is_free, start + np.linspace(0, 1, 3000)[:, None] * (end - start)))
            assert proof.free_fraction(start, end, PROOF) == 1.0
        elif proof.is_free(start):
            share = proof.free_fraction(start, end, PROOF)
            assert share < 1.0
            assert proof.is_free(start + share * (end - start))
    assert 5 < sum(verdicts) < 35


@pytest.mark.parametrize("steps", [0, 1, 2, 3, 7, 8, 9, 100])
def test_halving_order_visits_every_inner_point_once_coarse_first(steps: int) -> None:
    shares = halving_order(steps)[:, 0]
    assert sorted(np.round(shares * steps)) == list(range(1, steps))
    if steps == 8:
        assert shares.tolist() == [0.5, 0.25, 0.75, 0.125, 0.625, 0.375, 0.875]


def test_an_unknown_tomato_is_named(compiled: CompiledScene) -> None:
    with pytest.raises(InvalidValueError, match=r"target 12.*tomatoes 0 to 11"):
        planning_model(compiled, 12)


def test_the_clearance_of_a_path_is_that_of_all_its_configurations(compiled: CompiledScene) -> None:
    rng, start, reaches = np.random.default_rng(5), compiled.robot.upright_start, arm_reaches(compiled.robot)
    model = planning_model(compiled, TARGET, margin=0.0, pairs=("tomatoes", "stems", "clutter"))
    target = compiled.tomato_geom(TARGET)
    model.geom_contype[target] = model.geom_conaffinity[target] = 0
    obstacles = np.arange(compiled.obstacle_geoms.start, compiled.obstacle_geoms.stop)
    set_margin(model, obstacles, CLEARANCE_RANGE)
    checker, found = CollisionChecker(model), []
    for _ in range(12):
        path = np.array([start, start + rng.uniform(-1, 1, 6), start + rng.uniform(-1.5, 1.5, 6)])
        along = along_path(path, reaches, 0.01)
        expected = min(CLEARANCE_RANGE, *(checker.clearance(q) for q in along))
        assert path_clearance(compiled, TARGET, path) == expected
        found.append(expected)
    assert min(found) < 0 < max(found)
