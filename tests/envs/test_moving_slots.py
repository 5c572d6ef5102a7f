"""A row longer than its slots: slots move on with the cart, and nothing else changes."""

from __future__ import annotations

import copy
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.harvest.harvester import OracleHarvester
from greenhouse_gym.agents.harvest.rail import drive
from greenhouse_gym.agents.harvest.rehearsal import Rehearsal
from greenhouse_gym.build.scenes import BuildSettings, truth_in_scene
from greenhouse_gym.crops import grow_row
from greenhouse_gym.crops.crop import STEM_LINE
from greenhouse_gym.envs import make_env, make_vec_env
from greenhouse_gym.envs.environment import GreenhouseEnv
from greenhouse_gym.envs.tasks.harvest import TomatoHarvest
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, arrays_of, pose
from greenhouse_gym.motion.distance_field import NO_TOMATO, FieldStore
from greenhouse_gym.robots import mount_on_rail
from greenhouse_gym.scene import ArmPlacement, Scene
from greenhouse_gym.scene.mjcf import base_position
from greenhouse_gym.scene.plants.layout import Layout
from greenhouse_gym.scene.plants.live import LivePlants
from greenhouse_gym.scene.plants.live_scene import live_scene
from greenhouse_gym.scene.plants.slots import check_fits
from greenhouse_gym.scene.plants.states import CRATED, HANGING, LOST, WAITING
from greenhouse_gym.scene.plants.topology import topology_of
from greenhouse_gym.scene.scene import Provenance, Target

LENGTH, REACH = 3.0, 1.2
LAYOUT = Layout(trusses=3, fruit=5, leaves=4, loose=5)


@cache
def scene() -> Scene:
    """A row whose scan shows everything."""
    row = grow_row(seed=1, length=LENGTH)
    there = pose(translation=[0.6 - STEM_LINE, -LENGTH / 2, 0.0])
    truth = truth_in_scene(row, there, BuildSettings(reach=LENGTH))
    parts = {"tomatoes": truth.tomatoes, "stems": truth.stems, "clutter": truth.clutter}
    return Scene(
        name="long", placement=ArmPlacement(), provenance=Provenance(row="long"), truth=truth,
        targets=(Target(tomato=0, difficulty="easy"),), **parts,
    )  # fmt: skip


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    arm: Path = mount_on_rail("ur5e", tmp_path_factory.mktemp("arm") / "rail.xml", REACH)
    return {
        "scene": scene(), "split": "train", "robot": arm, "task": TomatoHarvest("row", layout=LAYOUT),
        "plants": "compliant", "physics": "truth", "action": "joint", "bank": "mini",
    }  # fmt: skip


@pytest.fixture(scope="module")
def env(options: dict[str, Any]) -> GreenhouseEnv:
    return make_env(**options)


def plants_of(env: GreenhouseEnv) -> LivePlants:
    return env.simulation.live(0).plants


def hanging(env: GreenhouseEnv) -> list[int]:
    """Return the fruit that hang, in slots or not."""
    return np.flatnonzero(np.isin(plants_of(env).state, (HANGING, WAITING))).tolist()


def centers(env: GreenhouseEnv) -> Array:
    """Return the middles (n, 3) of the fruit that hang."""
    return np.array([plants_of(env).center(k) for k in hanging(env)])


def to(speed: float) -> np.ndarray:
    """Return the action that drives the cart, with an open cup."""
    return np.array([speed, 0, 0, 0, 0, 0, 0, -1], dtype=np.float32)


def test_slots_move_on_to_the_whole_row_and_nothing_jumps(env: GreenhouseEnv) -> None:
    _, info = env.reset(seed=0)
    plants = plants_of(env)
    first, leaves, before = set(plants.seated.tolist()), plants.leaves, centers(env)
    seen, swaps = set(first), 0
    for speed in (1, -1):
        for _ in range(110 * (1 + (speed < 0))):
            slots = plants.seated.copy()
            *_, info = env.step(to(speed))
            swaps += int((slots != plants.seated).any())
            np.testing.assert_allclose(centers(env), before, atol=1e-5)
            seen |= set(plants.seated.tolist())
    assert swaps > 8
    assert len(first) == LAYOUT.trusses < len(plants.planted.trusses)
    assert len(seen) >= 3 * LAYOUT.trusses
    assert set(plants.leaves) != set(leaves)
    assert (info["damaged"], info["knocked"]) == (0, 0)
    assert info["wanted"] == plants.left == len(env.simulation.episode(0).fruit)


def test_a_truss_in_a_slot_later_is_as_one_from_the_start(env: GreenhouseEnv, options: dict[str, Any]) -> None:
    every = make_env(**options | {"task": TomatoHarvest("row", layout=Layout(trusses=20, fruit=5, leaves=4, loose=5))})
    every.reset(seed=0)
    env.reset(seed=0)
    for _ in range(100):
        env.step(to(1))
    model, plants = env.simulation.live(0).model, plants_of(env)
    fresh, whole = every.simulation.live(0).model, plants_of(every)
    slot = int(np.argmax(plants.seated))
    rows = [one.root.tolist() for one in whole.planted.trusses]
    other = rows.index(plants.planted.trusses[plants.seated[slot]].root.tolist())
    assert plants.seated[slot] >= LAYOUT.trusses
    for mine, its in zip(bodies_of(plants, slot), bodies_of(whole, other), strict=True):
        first, second = (parts_of(m, body) for m, body in ((model, mine), (fresh, its)))
        for name, values in first.items():
            np.testing.assert_allclose(values, second[name], rtol=1e-9, atol=1e-15, err_msg=name)


def bodies_of(plants: LivePlants, slot: int) -> list[int]:
    """Return the bodies of a slot: the truss and its fruit."""
    ids = plants.planted.ids
    return [int(ids.truss[slot]), *ids.fruit[slot].tolist()]


def parts_of(model: mujoco.MjModel, body: int) -> dict[str, Array]:
    """Return all constants of a body, its joints and its geoms."""
    joints, dofs, geoms = (np.flatnonzero(of == body) for of in (model.jnt_bodyid, model.dof_bodyid, model.geom_bodyid))
    springs = model.jnt_qposadr[joints]
    names = {"body_": body, "jnt_": joints, "dof_": dofs, "geom_": geoms}
    fields = (
        "body_mass", "body_inertia", "body_ipos", "body_subtreemass", "body_pos", "jnt_stiffness", "jnt_axis",
        "dof_damping", "geom_type", "geom_size", "geom_pos", "geom_quat", "geom_rgba", "geom_rbound",
        "geom_conaffinity", "geom_contype",
    )  # fmt: skip
    found = {name: getattr(model, name)[names[name[: name.index("_") + 1]]] for name in fields}
    return found | {"springs": model.qpos_spring[springs]}


@pytest.mark.parametrize("emptied", [True, False])
def test_a_truss_without_some_fruit_stays_where_it_rose_to(env: GreenhouseEnv, emptied: bool) -> None:
    env.reset(seed=0)
    plants = plants_of(env)
    wanted = plants.wanted.reshape(-1, LAYOUT.fruit)
    slot = int(np.argmax(wanted[plants.seated].sum(axis=1)))
    truss = int(plants.seated[slot])
    numbers = truss * LAYOUT.fruit + np.flatnonzero(wanted[truss])
    gone, rest = (numbers, numbers[:0]) if emptied else (numbers[1:], numbers[:1])
    plants._pull[gone] = 1000.0  # N, summed over the steps of an action: they come off
    plants.data.qvel[np.isin(plants.model.dof_bodyid, plants.planted.ids.truss[slot])] = 0.1  # wakes the truss
    organ, scanned = plants.planted.trusses[truss], plants.planted.compiled.scene.arrays
    rachis = plants._static(organ.rows)
    for _ in range(300):
        if truss not in plants.seated:
            break
        assert (plants.model.geom_rgba[rachis, 3] == 0).all(), "the slot has it"
        before = live_scene(plants, plants.planted.compiled, leaves=True)
        env.step(to(0 if (plants.state[gone] < LOST).any() else 1))
    assert (plants.state[gone] == LOST).all()
    assert (plants.model.geom_rgba[rachis, 3] > 0).all()
    middles = (scanned.starts + scanned.ends)[[*organ.rows]] / 2
    assert np.abs(plants.data.geom_xpos[rachis] - middles).max() > 2e-3, "the truss rose"
    for state in (WAITING, HANGING):
        assert (plants.state[rest] == state).all()
        now = live_scene(plants, plants.planted.compiled, leaves=True)
        assert now.tomatoes.keys() == before.tomatoes.keys()
        for one, other in ((now.scene.tomatoes, before.scene.tomatoes), (now.scene.stems, before.scene.stems)):
            np.testing.assert_allclose(arrays_of(one).starts, arrays_of(other).starts, atol=1e-3)
        assert not {*gone.tolist()} & {*now.tomatoes}, "fruit that came off are not there"
        assert plants.left == plants.wanted.sum() - len(gone)
        for _ in range(100 if emptied else 300):
            env.step(to(-1))
            if truss in plants.seated:
                break
        for _ in range(20):
            env.step(to(0))
    assert (truss in plants.seated) != emptied, "only a truss with ripe fruit gets its slot back"


def test_a_drive_repeats_its_rehearsal_bit_for_bit(env: GreenhouseEnv) -> None:
    env.reset(seed=0)
    start = set(plants_of(env).seated.tolist())
    problem = Problem.of(env.simulation, 0, 0, knows_truth=True)
    trial = Rehearsal(problem)
    for action in drive(problem, "RRTConnect", REACH):
        env.step(action)
        trial.step(problem.joint_steps * action[:-1], False)
    live = env.simulation.live(0)
    assert set(live.plants.seated.tolist()) != start
    np.testing.assert_array_equal(live.plants.seated, trial.plants.seated)
    np.testing.assert_array_equal(live.data.qpos, trial.plants.data.qpos)
    np.testing.assert_array_equal(live.model.geom_pos, trial.plants.model.geom_pos)


def test_a_copy_moves_on_independently(env: GreenhouseEnv) -> None:
    env.reset(seed=0)
    for _ in range(40):
        env.step(to(1))
    twin, slots = copy.deepcopy(env), plants_of(env).seated.copy()
    ahead = [twin.step(to(1))[0] for _ in range(50)]
    assert (plants_of(twin).seated != slots).any()
    np.testing.assert_array_equal(plants_of(env).seated, slots)
    np.testing.assert_array_equal(ahead, [env.step(to(1))[0] for _ in range(50)])
    np.testing.assert_array_equal(plants_of(twin).seated, plants_of(env).seated)


def test_vector_equals_single_along_a_row(env: GreenhouseEnv, options: dict[str, Any]) -> None:
    both = make_vec_env(2, **options)
    actions = np.stack([np.stack([to(1), to(-1)])] * 90)
    trace = [both.reset(seed=5)[0]] + [both.step(action)[0] for action in actions]
    for i in range(2):
        alone = [env.reset(seed=5 + i)[0]] + [env.step(action[i])[0] for action in actions]
        np.testing.assert_array_equal(alone, [observations[i] for observations in trace])


@pytest.mark.slow
def test_an_oracle_picks_fruit_that_had_no_slot(env: GreenhouseEnv) -> None:
    observation, info = env.reset(seed=0)
    first = plants_of(env).seated.tolist()
    agent = OracleHarvester()
    agent.reset(Problem.of(env.simulation, 0, 0, knows_truth=True))
    late = np.zeros(0)
    while len(late) < 3 and info["steps"] < 3000:
        observation, *_, info = env.step(agent.act(observation))
        crated = np.flatnonzero(plants_of(env).state == CRATED)
        late = crated[~np.isin(crated // LAYOUT.fruit, first)]
    assert len(late) == 3
    assert info["crated"] == len(crated)


def test_distances_and_the_fruit_in_work_follow_the_cart(env: GreenhouseEnv) -> None:
    env.reset(seed=0)
    for _ in range(84):
        env.step(to(1))
    state, rail = env.simulation.state, float(env.simulation.joints[0, 0])
    assert state is not None
    ripe = centers(env)[plants_of(env).wanted[hanging(env)]]
    work = np.linalg.norm(ripe - env.simulation.tip(0), axis=1).min()
    assert np.linalg.norm(state.target[0] - state.tip[0]) == pytest.approx(work, abs=1e-6)
    points = state.tip[:, None] + np.random.default_rng(0).uniform([0, -0.2, -0.6], [0.3, 0.2, 0.3], (50, 3))
    found, _ = state.distances_at(points)
    solid, base = scene().arrays, base_position(scene(), env.simulation.robot)
    solid = solid.select(np.delete(np.arange(scene().count), scene().leaves))
    store = FieldStore()
    slot = store.add(solid, len(scene().tomatoes), pose(translation=base + [0.0, 1.0, 0.0]))
    expected, _ = store.lookup(np.array([slot]), np.full(1, NO_TOMATO), points - [0.0, 1.0, 0.0])
    assert rail == pytest.approx(1.0, abs=0.12)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert len(np.unique(found)) > 20


def test_more_ripe_fruit_on_a_truss_than_in_a_slot_are_refused() -> None:
    topology = topology_of(scene().truth, "long")
    truss = max(topology.trusses, key=lambda one: len(one.fruit))
    with pytest.raises(
        InvalidValueError, match=r"fruit on 1 trusses, up to \d+ on one, do not fit into 3 slots of 2 fruit"
    ):
        check_fits(topology, [one.row for one in truss.fruit], Layout(3, 2, 4), "long", moves_on=True)
