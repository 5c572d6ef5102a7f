from __future__ import annotations

import copy
from pathlib import Path

import mujoco
import numpy as np
import pytest

from greenhouse_gym.envs import GreenhouseEnv, GreenhouseVectorEnv, physics
from greenhouse_gym.robots import ROBOTS
from greenhouse_gym.scene import SceneBank, compile_scene, geom_order


def with_other_servos(folder: Path) -> Path:
    """A UR5e whose servos are damped and limited as those of files from elsewhere often are."""
    text = ROBOTS["ur5e"].read_text()
    for servo, kp in (('kp="4000" kv="240"', 4000), ('kp="1000" kv="60"', 1000)):
        assert servo in text
        text = text.replace(servo, f'kp="{kp}" dampratio="1" inheritrange="1"')
    path = folder / "other.xml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("servos", ["own", "other"])
def test_servos_move_as_if_told_where_to_be_in_every_physics_step(bank: SceneBank, tmp_path: Path, servos: str) -> None:
    """The same motion as plain MuJoCo's position servos that follow a ramp."""
    robot = "ur5e" if servos == "own" else with_other_servos(tmp_path)
    env, random, steps = GreenhouseEnv(bank=bank, robot=robot), np.random.default_rng(0), 0
    for seed in range(4):
        env.reset(seed=seed)
        compiled = compile_scene(env.scene, env.robot)
        model = copy.copy(compiled.model)
        compiled.allow_cup_on(model, env.target)
        data = mujoco.MjData(model)
        data.qpos[:] = data.ctrl[:] = last = env.start
        for _ in range(25):
            *_, terminated, _, _ = env.step(random.uniform(-1, 1, 6))
            command = env.simulation.command[0].copy()
            for k in range(5):
                data.ctrl[:] = last + (command - last) * ((k + 1) / 5)
                mujoco.mj_step(model, data)
            last, steps = command, steps + 1
            np.testing.assert_allclose(env.simulation.state.joints[0], data.qpos, atol=1e-10)
            if terminated:
                break
    assert steps > 40


@pytest.mark.parametrize("count", [1, 3])
def test_how_the_broad_phase_lists_the_geoms_changes_nothing(
    bank: SceneBank, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    """The same motions and touches, bit for bit, as MuJoCo that goes through all geoms in its own order."""
    played, collided, random = [], [], np.random.default_rng(0)
    actions = np.repeat(random.uniform(-1, 1, (12, count, 6)), 40, axis=0)
    for told_of_all in (False, True):
        if told_of_all:
            monkeypatch.setattr(geom_order, "_MIN_LISTED", 10**9)
            monkeypatch.setattr(physics, "put_arm_first", lambda model: None)
        env = GreenhouseVectorEnv(count, bank=bank, autoreset_mode="SameStep", threads=1)
        env.reset(seed=0)
        seen = [env.step(action) for action in actions]
        played.append([np.concatenate([part.ravel() for part in step[:4]]) for step in seen])
        collided.append([list(step[4]["contact"]) for step in seen])
        models = env.simulation._physics.models
        assert len({int(model.body_geomnum[0]) for model in models}) == 1
        assert models[0].body_geomnum[0] > env.simulation.worlds.capacity
        assert models[0].ngeom > env.simulation.worlds.capacity + 10
        assert sum(step[2].sum() for step in seen) > 2, "arms touch something"
    np.testing.assert_array_equal(*played)
    assert collided[0] == collided[1]
