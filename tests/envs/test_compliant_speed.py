"""Shortcuts of compliant plants change no number: models filled again, constants, and organs out of reach."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest

from greenhouse_gym.envs import GreenhouseVectorEnv, compliant_physics, make_env
from greenhouse_gym.envs.compliant_simulation import CompliantSimulation
from greenhouse_gym.envs.contacts import CONTACT_GROUPS, LEAF
from greenhouse_gym.envs.randomization import Randomization
from greenhouse_gym.scene import SceneBank
from greenhouse_gym.scene.geom_order import first_world_geom
from greenhouse_gym.scene.plants.detachment import update_constants
from greenhouse_gym.scene.plants.out_of_reach import Organs
from greenhouse_gym.scene.world_tree import copy_whole_tree

OPTIONS = {"bank": "mini", "task": "harvest", "plants": "compliant", "physics": "truth"}
NAMES = SceneBank.open("mini").names()


def numbers_of(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return all arrays of a model but its names, and its statistics."""
    arrays = {name: getattr(model, name) for name in dir(model) if not name.startswith(("_", "names"))}
    own = slice(
        int(model.body_bvhnum[0]), int(model.body_bvhadr[1:][model.body_bvhnum[1:] > 0].min(initial=model.nbvh))
    )
    for name in [name for name in arrays if name.startswith("bvh_")]:  # nodes that belong to no body, and what draws
        arrays[name] = np.delete(arrays[name], own, axis=0) if name != "bvh_depth" else None
    statistics = np.array([model.stat.meaninertia, model.stat.meanmass, model.stat.extent])
    return {k: v.copy() for k, v in arrays.items() if isinstance(v, np.ndarray)} | {"stat": statistics}


def assert_equal(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert found.keys() == expected.keys()
    assert [name for name in expected if not np.array_equal(found[name], expected[name], equal_nan=True)] == []


def live(env: object, i: int = 0) -> CompliantSimulation:
    return env.simulation.live(i)  # type: ignore[attr-defined, no-any-return]


@pytest.mark.parametrize("size", ["pick", "stand"])
def test_a_model_that_held_other_plants_equals_a_fresh_one(size: str) -> None:
    used = make_env(**OPTIONS, size=size, randomization=Randomization(base_position=0.02, base_yaw=0.1, mechanics=0.2))
    rng = np.random.default_rng(0)
    for seed, name in enumerate(NAMES[:3]):
        used.reset(seed=seed, options={"scene": name})
        for _ in range(15):
            used.step(np.append(rng.uniform(-1, 1, 6) + [0.4, 0, 0, 0, 0, 0], 1.0))
    used.reset(seed=7, options={"scene": NAMES[0]})
    fresh = make_env(**OPTIONS, size=size, randomization=used.simulation.randomization)
    fresh.reset(seed=7, options={"scene": NAMES[0]})
    assert_equal(numbers_of(live(used).model), numbers_of(live(fresh).model))
    np.testing.assert_array_equal(live(used).data.qpos, live(fresh).data.qpos)
    np.testing.assert_array_equal(live(used).data.geom_xpos, live(fresh).data.geom_xpos)


def test_constants_are_those_of_the_whole_model() -> None:
    env = make_env(**OPTIONS)
    env.reset(seed=0)
    model = live(env).model
    assert first_world_geom(model) > 0
    before = model.dof_M0.copy()
    model.body_mass[live(env).plants.planted.ids.truss] *= 1.5
    whole = copy.copy(model)
    copy_whole_tree(live(env).world.compiled.model, whole)
    rules = whole.eq_data.copy()
    mujoco.mj_setConst(whole, mujoco.MjData(whole))
    whole.eq_data[:] = rules
    update_constants(model, mujoco.MjData(model))
    copy_whole_tree(live(env).world.compiled.model, model)
    assert not np.array_equal(model.dof_M0, before)
    assert_equal(numbers_of(model), numbers_of(whole))


def rollout(count: int, steps: int) -> tuple[np.ndarray, ...]:
    """Move arms at random toward the plants and back; return what the environments returned."""
    env = GreenhouseVectorEnv(count, **OPTIONS, threads=1)
    env.reset(seed=3)
    rng, rows = np.random.default_rng(3), []
    for k in range(steps):
        action = rng.uniform(-1, 1, (count, 7)).astype(np.float32)
        action[:, 0] += 0.8 if k % 30 < 20 else -0.8
        observation, reward, terminated, truncated, info = env.step(action)
        rows.append(
            [
                observation,
                reward,
                terminated,
                truncated,
                np.column_stack([info["contacts"][group] for group in CONTACT_GROUPS]),
            ]
        )
    states = [np.concatenate([live(env, i).data.qpos, live(env, i).data.qvel]) for i in range(count)]
    return *(np.array(column) for column in zip(*rows, strict=True)), np.array(states)


def test_hidden_organs_change_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    hidden, hide = [], Organs.hide
    monkeypatch.setattr(Organs, "hide", lambda self, far, turns: (hidden.append(far.mean()), hide(self, far, turns)))
    found = rollout(6, 90)
    assert len(hidden) > 150
    assert 0.5 < np.mean(hidden) < 1
    monkeypatch.setattr(compliant_physics, "hide_out_of_reach", lambda chosen, turns: None)
    for one, other in zip(found, rollout(6, 90), strict=True):
        np.testing.assert_array_equal(one, other)
    assert found[-2][..., LEAF].sum() > 0


def test_organs_are_shown_when_an_arm_turns_farther_than_foreseen() -> None:
    env = make_env(**OPTIONS)
    env.reset(seed=0)
    organs, model, data = live(env).organs, live(env).model, live(env).data
    masks = model.body_conaffinity.copy()
    organs.hide(np.ones(organs.boxes.shape[1], dtype=np.bool_), [0.01] * 6)
    assert (model.body_conaffinity != masks).sum() > 5
    data.qpos[2] += 0.009
    organs.check()
    assert organs.hidden
    data.qpos[2] += 0.002
    organs.check()
    assert not organs.hidden
    np.testing.assert_array_equal(model.body_conaffinity, masks)
