"""The cutter: trusses that come off whole, in the tool and out of it, and the agent that lays them into the crate."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.harvest.truss_cutter import TrussCutter
from greenhouse_gym.envs import make_env
from greenhouse_gym.envs.environment import GreenhouseEnv
from greenhouse_gym.envs.tasks.harvest import TomatoHarvest
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.scene.plants import cutting
from greenhouse_gym.scene.plants.layout import LOOSE
from greenhouse_gym.scene.plants.live import LivePlants
from greenhouse_gym.scene.plants.states import HANGING, LOST

OPTIONS: dict[str, Any] = {"bank": "mini", "plants": "compliant", "physics": "truth", "action": "joint"}
BEEFSTEAK, CHERRY = "helios-beefsteak-2001-w05-01", "helios-cherry-2005-w01-00"
ON, OFF = np.array([0.0] * 6 + [1.0]), np.array([0.0] * 6 + [-1.0])


@pytest.fixture
def env() -> GreenhouseEnv:
    made = make_env(**OPTIONS, task=TomatoHarvest("truss", tool="cutter"), scene=BEEFSTEAK)
    made.reset(seed=0)
    return made


def centers(env: GreenhouseEnv) -> np.ndarray:
    return middles(env.simulation.live(0).plants)


def middles(plants: LivePlants) -> np.ndarray:
    return np.array([plants.center(k) for k in np.flatnonzero(plants.planted.fruit.ravel() >= 0)])


def test_a_cut_truss_keeps_shape_mass_and_place_and_leaves_nothing(env: GreenhouseEnv) -> None:
    live = env.simulation.live(0)
    model, ids, before = live.model, live.plants.planted.ids, centers(env)
    mass = model.body_subtreemass[ids.truss[0]]
    cutting.swap_truss(model, live.data, live.plants._scratch, ids.truss[0], ids.fruit[0], ids.cut[0], ids.cut_fruit[0])
    live.plants._bodies[:] = ids.cut_fruit[0]
    np.testing.assert_allclose(centers(env), before, atol=1e-9)
    assert model.body_subtreemass[ids.cut[0]] == pytest.approx(mass)
    assert model.body_subtreemass[ids.truss[0]] < 0.05
    left = np.isin(model.geom_bodyid, [ids.truss[0], *ids.fruit[0]])
    assert not model.geom_rgba[left, 3].any(), "shapes that float where the truss hung"
    assert not model.geom_conaffinity[left].any()


def test_a_truss_hangs_in_the_tool_and_falls_when_it_opens(env: GreenhouseEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    env.step(ON)
    live = env.simulation.live(0)
    assert not live.plants.holding, "nothing is within reach"
    monkeypatch.setattr(cutting, "CUT_GAP", 10.0)
    trace = [centers(env)]
    for _ in range(40):
        *_, info = env.step(ON)
        trace.append(centers(env))
    weight = live.model.body_subtreemass[live.plants.planted.ids.cut[0]] * 9.81
    felt = env.simulation.state.plants
    assert (info["detached"], info["knocked"]) == (4, 0)
    assert np.abs(np.diff(trace, axis=0)).max() < 0.02, "a jump"
    assert felt["force"][0] == pytest.approx([0.0, 0.0, -weight], abs=0.15 * weight)
    assert felt["held"][0] == 1
    twin = env.simulation.rehearsal(0)  # goes on when the episode is over
    fallen = twin.simulation(0)
    for _ in range(80):
        twin.advance(twin.command, np.array([False]))
    model, data, ids = fallen.model, fallen.data, fallen.plants.planted.ids
    assert not any(warning.number for warning in data.warning)
    root = int(model.jnt_dofadr[model.body_jntadr[ids.cut[0]]])
    assert np.abs(data.qvel[root : root + 3]).max() < 0.02, "it lies"
    assert data.xpos[ids.cut[0], 2] < live.data.xpos[ids.cut[0], 2] - 0.1
    own = np.flatnonzero(np.isin(model.geom_bodyid, [ids.cut[0], *ids.cut_fruit[0]]) & (model.geom_contype > 0))
    standing = np.flatnonzero((model.geom_bodyid == 0) & ((model.geom_conaffinity & LOOSE) > 0))
    standing = standing[np.abs(data.geom_xpos[standing] - data.xpos[ids.cut[0]])[:, :2].max(axis=1) < 3.0]
    gaps = [mujoco.mj_geomDistance(model, data, int(a), int(b), 0.1, None) for a in own[:10] for b in standing]
    assert min(gaps) < 0.002, "nothing floats"
    assert (fallen.plants.state[:4] == LOST).all()
    touching = model.geom_bodyid[data.contact.geom].ravel()
    bare = [body for body in ids.cut_fruit[0][:4] if not model.geom_rgba[model.body_geomadr[body], 3]]
    assert not np.isin(bare, touching).any(), "fruit that came off left no ghost"


def test_a_script_cuts_a_truss_and_lays_it_into_the_crate() -> None:
    env = make_env(**OPTIONS, task=TomatoHarvest("truss", tool="cutter"), scene=CHERRY)
    observation, info = env.reset(seed=3)
    agent = TrussCutter()
    agent.reset(Problem.of(env.simulation, 0, 3, knows_truth=True))
    over, held = False, False
    while not over:
        observation, _, terminated, truncated, info = env.step(agent.act(observation))
        over, held = terminated or truncated, held or env.simulation.live(0).plants.holding
    assert held
    assert info["is_success"]
    assert info["crated"] == info["wanted"] > 5
    assert (info["dropped"], info["knocked"], info["damaged"]) == (0, 0, 0)
    assert not (env.simulation.live(0).plants.state == HANGING).any()


def test_a_copy_holds_its_own_truss(env: GreenhouseEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cutting, "CUT_GAP", 10.0)
    twin = env.simulation.rehearsal(0)
    env.step(ON)
    assert not twin.simulation(0).plants.holding
    copied = env.simulation.rehearsal(0)
    env.step(OFF)
    assert copied.simulation(0).plants.holding
    assert not env.simulation.live(0).plants.holding


def test_a_cutter_is_asked_for_by_name() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown tool 'saw'.*suction, cutter"):
        TomatoHarvest(tool="saw")
    cup = make_env(**OPTIONS, task="harvest", scene=BEEFSTEAK)
    cup.reset(seed=0)
    with pytest.raises(InvalidValueError, match='needs task=TomatoHarvest\\("truss", tool="cutter"\\)'):
        TrussCutter().reset(Problem.of(cup.simulation, 0, 0, knows_truth=True))
