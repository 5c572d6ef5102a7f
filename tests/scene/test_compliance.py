"""Compliant plants against theory: masses, a beam under load, a pendulum, rest, and random shoving."""

import copy
from functools import lru_cache, partial

import mujoco
import numpy as np
import pytest

from greenhouse_gym.agents import Problem
from greenhouse_gym.agents.harvest.harvester import OracleHarvester
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.envs import make_env
from greenhouse_gym.envs.randomization import Randomization
from greenhouse_gym.envs.stepping import drive_and_record
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box, Capsule, Ellipsoid, Sphere, arrays_of
from greenhouse_gym.scene import SceneBank, Shapes, compile_scene
from greenhouse_gym.scene.obstacle_slots import TYPES, geoms_of
from greenhouse_gym.scene.plants.detachment import detach, load_of, weld
from greenhouse_gym.scene.plants.filled import FilledBodies
from greenhouse_gym.scene.plants.filling import merged
from greenhouse_gym.scene.plants.layout import LOOSE, Layout, SlotIds
from greenhouse_gym.scene.plants.mechanics import GRAVITY, HINGE_ARMATURE, VARYING, PlantMechanics, mass_properties
from greenhouse_gym.scene.plants.slots import choose_organs, empty_slots, plant
from greenhouse_gym.scene.plants.topology import topology_of
from greenhouse_gym.scene.truth import true_scene

SCENE = "own-cluster-2000-w00-02"
LAYOUT = Layout(trusses=1, fruit=6, leaves=3)


def add(spec):
    drive_and_record(spec, 5)
    LAYOUT.add(spec)


def planted_with(compiled, topology, rows, layout):
    ids = SlotIds(compiled.model, layout)
    found = choose_organs(compiled, ids, topology, rows, layout, PlantMechanics(), FilledBodies())
    empty_slots(compiled.model, ids)
    plant(compiled.model, found, layout, mujoco.MjData(compiled.model))
    return found


@lru_cache
def planted():
    scene = true_scene(SceneBank.open("mini").scene(SCENE))
    topology = topology_of(scene, SCENE)
    compiled = compile_scene(scene, "ur5e", scene.count, add)
    truss = max(topology.trusses, key=lambda one: len(one.fruit))
    found = planted_with(compiled, topology, [fruit.row for fruit in truss.fruit][:1], LAYOUT)
    return compiled.model, found


@pytest.fixture
def model():
    return copy.copy(planted()[0])


@pytest.fixture
def ids():
    return planted()[1].ids


def test_every_fruit_of_the_small_bank_finds_its_truss():
    bank = SceneBank.open("mini")
    for name in bank.names()[:3]:
        truth = bank.scene(name).truth
        topology = topology_of(truth, name)
        rows = [fruit.row for truss in topology.trusses for fruit in truss.fruit]
        assert sorted(rows) == list(range(len(truth.tomatoes)))
        assert all(len({truth.tomatoes[f.row].truss for f in truss.fruit}) == 1 for truss in topology.trusses)


def test_sepals_belong_to_the_fruit_of_their_pedicel_and_leaflets_to_their_petiole():
    def stem(start, end, kind):
        return Stem(np.array(start), np.array(end), 0.002, kind=kind)

    def box(*center):
        return Box(np.array(center), np.array([0.006, 0.003, 0.001]), np.eye(3))

    stems = (
        stem([0, 0, 0], [0, 0, 1], "main"), stem([0, 0, 0.8], [-0.1, 0, 0.8], "peduncle"),
        stem([-0.1, 0, 0.8], [-0.1, 0, 0.77], "pedicel"),
    )  # fmt: skip
    sepal, curled, leaflet, far = box(-0.11, 0, 0.775), box(-0.1, 0.01, 0.78), box(-0.1, 0.022, 0.775), box(0.1, 0, 0.8)
    petioles = Capsule(np.zeros(3), np.array([-0.1, 0.03, 0.775]), 0.002), Capsule(np.zeros(3), far.center, 0.002)
    fruit = Tomato(Sphere(np.array([-0.1, 0, 0.755]), 0.015), 0)
    shapes = Shapes(tomatoes=(fruit,), stems=stems, clutter=(sepal, curled, leaflet, far, *petioles))
    topology = topology_of(shapes, "sepals")
    assert topology.trusses[0].fruit[0].calyx == (4, 5), "boxes from row 4 on"
    assert sorted(row for leaf in topology.leaves for row in leaf.plates) == [6, 7]


def test_mass_properties_equal_those_of_the_compiler():
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    shapes = [
        Sphere(np.array([0.1, 0, 0]), 0.03), Capsule(np.zeros(3), np.array([0.1, 0.05, 0.02]), 0.004),
        Ellipsoid(np.array([0, 0.1, 0]), np.array([0.03, 0.04, 0.05]), turn),
    ]  # fmt: skip
    found = mass_properties(arrays_of(shapes), PlantMechanics())
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_freejoint()
    for kind, position, size, quat in zip(*geoms_of(arrays_of(shapes)), strict=True):
        body.add_geom(type=TYPES[kind], pos=position, size=size, quat=quat, density=950)
    expected = spec.compile()
    assert found.mass == pytest.approx(expected.body_mass[1])
    np.testing.assert_allclose(found.center, expected.body_ipos[1], atol=1e-12)
    np.testing.assert_allclose(np.sort(found.inertia), np.sort(expected.body_inertia[1]))


def test_merged_plates_span_those_of_the_leaf_and_are_as_thin():
    rng = np.random.default_rng(0)
    centers = [np.append(rng.uniform(-0.2, 0.2, 2), 0.0) for _ in range(40)]
    boxes = arrays_of([Box(center, np.array([0.02, 0.01, 0.001]), np.eye(3)) for center in centers])
    few = merged(boxes, 5)

    def covers(k, center):
        return (np.abs((center - few.starts[k]) @ few.rotations[k]) <= few.sizes[k] + 1e-9).all()

    assert len(few.kinds) == 5
    assert all(any(covers(k, center) for k in range(5)) for center in boxes.starts)
    curved = merged(boxes._replace(starts=boxes.starts + [0.0, 0.0, 2.0] * boxes.starts[:, :1] ** 2), 5)
    assert curved.sizes.min(axis=1).max() <= 0.004


def test_plants_rest_where_they_were_scanned(model):
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 200)
    plants = slice(6, model.nq - 7 * LAYOUT.loose)
    np.testing.assert_allclose(data.qpos[plants], model.qpos0[plants], atol=1e-9)


def test_a_beam_under_load_bends_as_theory_says(model, ids):
    leaf = int(ids.leaf[0])
    swing = int(model.body_jntadr[leaf]) + 1
    stiffness, lever, force = float(model.jnt_stiffness[swing]), 0.1, 0.1
    data = mujoco.MjData(model)
    outward = np.cross(model.jnt_axis[swing - 1], model.jnt_axis[swing])
    side = np.cross([0.0, 0.0, 1.0], outward)
    expected = 0.0
    for _ in range(50):
        expected = force * lever * np.cos(expected) / stiffness
    angle = int(model.jnt_qposadr[swing])
    mujoco.mj_kinematics(model, data)
    for _ in range(1500):
        data.qfrc_applied[:] = 0
        point = data.xpos[leaf] + lever * (data.xmat[leaf].reshape(3, 3) @ outward)
        mujoco.mj_applyFT(model, data, force * side, np.zeros(3), point, leaf, data.qfrc_applied)
        mujoco.mj_step(model, data)
    assert abs(data.qpos[angle]) == pytest.approx(expected, rel=0.05)


def test_a_fruit_swings_at_the_frequency_of_a_pendulum(model, ids):
    fruit = int(ids.fruit[0, 0])
    joint, truss = int(model.body_jntadr[fruit]), int(ids.truss[0])
    hinges = model.jnt_dofadr[model.body_jntadr[truss]]
    model.dof_armature[hinges : hinges + 2] = 1e6  # the truss stands still
    dof, at = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
    model.dof_damping[dof : dof + 3] = 0
    model.opt.timestep = 0.002
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    drop = data.xanchor[joint][2] - data.xipos[fruit][2]
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    stiffness = model.jnt_stiffness[joint] + model.body_mass[fruit] * GRAVITY * drop
    # swings about the horizontal axes, which the inertia couples: the exact modes of the linear pendulum
    inertia = full[dof : dof + 3, dof : dof + 3]
    gravity = np.diag([stiffness, stiffness, model.jnt_stiffness[joint]])
    modes, shapes = np.linalg.eig(np.linalg.solve(inertia, gravity))
    mode = int(np.abs(shapes[2]).argmin())
    data.qvel[dof : dof + 3] = 0.2 * np.real(shapes[:, mode])
    trace = []
    for _ in range(2000):
        mujoco.mj_step(model, data)
        trace.append(data.qpos[at + 1 : at + 4] @ np.real(shapes[:, mode]))
    signs = np.flatnonzero(np.diff(np.sign(trace)))
    period = 2 * float(np.diff(signs).mean()) * model.opt.timestep
    assert 2 * np.pi / period == pytest.approx(float(np.sqrt(np.real(modes[mode]))), rel=0.05)


def test_halving_the_step_changes_deflections_little(ids):
    peaks = []
    for step in (0.01, 0.005, 0.002):
        model = copy.copy(planted()[0])
        model.opt.timestep = step
        data = mujoco.MjData(model)
        bodies = np.array([ids.truss[0], *ids.leaf])
        hinges = model.jnt_qposadr[model.body_jntadr[bodies]][:, None] + [0, 1]
        peak = np.zeros(hinges.shape)
        for k in range(round(1 / step)):  # pushed aside and down for half a second, then they swing back
            data.xfrc_applied[bodies, :3] = [0.0, 0.6, -0.6] if k * step < 0.5 else 0.0
            mujoco.mj_step(model, data)
            peak = np.maximum(peak, np.abs(data.qpos[hinges]))
        peaks.append(peak[peak > 0.03])
    assert peaks[0].max() > 0.15
    for finer in peaks[1:]:
        np.testing.assert_allclose(peaks[0], finer, rtol=0.15)


def test_hinges_keep_a_minimum_inertia(model, ids):
    for body in (*ids.truss, *ids.leaf):
        first = int(model.jnt_dofadr[model.body_jntadr[body]])
        assert (model.dof_armature[first : first + 2] >= HINGE_ARMATURE).all()


def test_pull_and_bend_add_up():
    mechanics = PlantMechanics()
    load = partial(load_of, mechanics=mechanics)
    assert load(mechanics.pull_limit, 0.0) == pytest.approx(1)
    assert load(0.0, mechanics.bend_limit) == pytest.approx(1)
    assert load(mechanics.pull_limit / 2, mechanics.bend_limit / 2) == pytest.approx(1)


def test_randomization_draws_mechanics():
    options = {"bank": "mini", "task": "harvest", "plants": "compliant", "physics": "truth", "scene": SCENE}
    env = make_env(**options, randomization=Randomization(mechanics=0.3))
    drawn = []
    for seed in (0, 1, 0):
        env.reset(seed=seed)
        drawn.append(env.simulation.live(0).plants.planted.mechanics)
    assert drawn[0] == drawn[2] != drawn[1]
    factors = [getattr(drawn[0], name) / getattr(PlantMechanics(), name) for name in VARYING]
    assert len(set(factors)) == len(VARYING)
    assert 0.7 <= min(factors) < 1 < max(factors) <= 1.3
    with pytest.raises(InvalidValueError, match="mechanics must be below 1"):
        Randomization(mechanics=1.0)


def test_an_arm_presses_a_stem_with_no_more_than_its_servos_force():
    model = copy.copy(planted()[0])
    assert model.actuator_forcerange[:, 1].tolist() == [150, 150, 150, 37.5, 37.5, 37.5]
    data = mujoco.MjData(model)
    data.act[:] = 1.5  # far inside floor and gutter
    mujoco.mj_step(model, data, 100)
    assert (np.abs(data.actuator_force) <= model.actuator_forcerange[:, 1]).all()
    assert np.abs(data.actuator_force).max() == pytest.approx(150)


def test_fruit_that_comes_off_meanwhile_leaves_the_weld_of_a_held_one(model, ids):
    data, scratch = mujoco.MjData(model), mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    held, other = (int(body) for body in ids.fruit[0, :2])
    first, second = (int(body) for body in ids.loose[:2])
    detach(model, data, scratch, held, first, 950.0)
    mujoco.mj_forward(model, data)
    weld(model, data, ids, first)
    rule = model.eq_data[ids.weld].copy()
    detach(model, data, scratch, other, second, 950.0)
    np.testing.assert_array_equal(model.eq_data[ids.weld], rule)


def test_loose_fruit_pass_the_static_stems_that_they_overlap(model, ids):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    world = np.arange(model.body_geomadr[0], model.body_geomadr[0] + model.body_geomnum[0])
    stopping = world[(model.geom_conaffinity[world] & LOOSE) > 0]
    assert len(stopping) > 10
    for body in ids.fruit[0]:
        fruit = int(model.body_geomadr[body])
        assert all(mujoco.mj_geomDistance(model, data, fruit, int(geom), 0.01, None) >= 0 for geom in stopping)


@pytest.mark.parametrize("name", ["own-beefsteak-2012-w00-01", "helios-beefsteak-2025-w05-02"])
def test_a_truss_that_loses_a_heavy_fruit_rises_a_little_and_does_not_fall_over(name):
    scene = true_scene(SceneBank.open("default").scene(name))
    topology = topology_of(scene, name)
    layout = Layout(trusses=1, fruit=12, leaves=1)
    compiled = compile_scene(scene, "ur5e", scene.count, lambda spec: (drive_and_record(spec, 5), layout.add(spec)))
    truss = max(topology.trusses, key=lambda one: sum(scene.tomatoes[f.row].radius ** 3 for f in one.fruit))
    rows, mechanics = [fruit.row for fruit in truss.fruit], PlantMechanics()
    ids = planted_with(compiled, topology, rows, layout).ids
    hinge = int(compiled.model.jnt_qposadr[compiled.model.body_jntadr[ids.truss[0]]])
    for k in range(len(rows)):
        model = copy.copy(compiled.model)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        detach(model, data, mujoco.MjData(model), int(ids.fruit[0, k]), int(ids.loose[0]), mechanics.density)
        bends = []
        for _ in range(300):
            mujoco.mj_step(model, data)
            bends.append(np.linalg.norm(data.qpos[hinge : hinge + 2]))
        assert 0.01 < bends[-1] < mechanics.max_sag
        assert max(bends) < mechanics.truss_bend_limit


def shove(scene, seconds, seed):
    """Move an arm at random among plants, then let them swing; return bends (rad) at the end and warnings."""
    env = make_env(
        bank="mini", task="harvest", plants="compliant", physics="truth", scene=scene, action="tip_velocity",
        step_limit=10**6,
    )  # fmt: skip
    env.reset(seed=seed)
    simulation = env.simulation
    rng = np.random.default_rng(seed)
    for _ in range(round(20 * seconds)):
        if rng.random() < 0.1 or not _:
            action = np.append(rng.uniform(-1, 1, 6) + [0.3, 0, 0, 0, 0, 0], -1.0)[None]
        simulation.step(action)
    live = simulation.live(0)
    # an arm that is stuck between static plants would hold leaves: put it back
    live.data.qpos[:6], live.data.qvel[:6], live.data.act[:] = simulation.robot.start, 0.0, simulation.robot.start
    for _ in range(180):
        simulation.step(np.zeros((1, 7)))
    plants = live.plants
    hinges = live.data.qpos[plants._hinges[:, None] + [0, 1]][1:]  # of leaves, which no fruit has left
    return hinges, sum(warning.number for warning in live.data.warning), live.data


def test_random_shoving_is_stable_and_leaves_swing_back():
    hinges, warnings, data = shove(SCENE, 8, 0)
    assert warnings == 0
    assert np.isfinite(data.qpos).all()
    assert np.abs(hinges).max() < np.radians(1)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(6))
def test_five_minutes_of_shoving_in_each_of_six_scenes(number):
    hinges, warnings, data = shove(SceneBank.open("mini").names()[number], 300, number)
    assert warnings == 0
    assert np.isfinite(data.qpos).all()
    assert np.abs(hinges).max() < np.radians(1)


@lru_cache
def picked_at_finer_steps(seed):
    """Return which fruit came off and the largest bends of the organs in an oracle's pick, at 10, 5 and 2 ms."""
    env = make_env(bank="mini", **(agent := OracleHarvester()).env_options)
    observation, _ = env.reset(seed=seed)
    agent.reset(Problem.of(env.simulation, 0, seed, agent))
    actions = []
    while not agent.status and len(actions) < 200:
        actions.append(agent.act(observation))
        observation, _, terminated, truncated, _ = env.step(actions[-1])
        if terminated or truncated:
            break
    return tuple(zip(*(replay(env, actions, seed, finer) for finer in (1, 2, 5)), strict=True))


@pytest.mark.slow
def test_the_same_fruit_come_off_at_finer_steps():
    picks = [picked_at_finer_steps(seed)[0] for seed in range(10)]
    assert np.mean([off[0] == other for off in picks for other in off[1:]]) >= 0.95


@pytest.mark.slow
@pytest.mark.xfail(reason="39 % of 18 large bends in 20 picks differ by more than 15 %, by up to a factor of 4.0")
def test_organs_bend_as_far_at_finer_steps():
    ratios = []
    for seed in range(10):
        first, *finer = picked_at_finer_steps(seed)[1]
        ratios += [first[first > 0.3] / other[first > 0.3] for other in finer]
    assert np.quantile(np.concatenate(ratios), [0.05, 0.95]) == pytest.approx([1, 1], abs=0.15)


def replay(env, actions, seed, finer):
    """Repeat actions with finer steps; return which fruit came off, and the largest bend (organs,) of each organ."""
    env.reset(seed=seed)
    physics, live = env.simulation._physics, env.simulation.live(0)
    step, timing = live.model.opt.timestep, physics._timing
    live.model.opt.timestep = step / finer
    physics._timing = timing._replace(substeps=finer * timing.substeps)
    bends = []
    for action in actions:
        env.simulation.step(action[None])
        bends.append(np.linalg.norm(live.data.qpos[live.plants._hinges[:, None] + [0, 1]], axis=1))
    physics._timing, live.model.opt.timestep = timing, step
    return (live.plants.state > 0).tolist(), np.max(bends, axis=0)
