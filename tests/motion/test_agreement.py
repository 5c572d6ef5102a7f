"""The planner's checker and the simulator agree on free configurations."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import make_scene, with_ellipsoids

from greenhouse_gym.envs import GreenhouseEnv
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.scene import SceneBank, compile_scene
from greenhouse_gym.scene.bank import write_bank


def disagreements_on_the_way(bank: SceneBank, episodes: int, names: list[str]) -> tuple[int, int, int]:
    """Configurations checked, collisions among them, and disagreements, over episodes of random actions."""
    random, env = np.random.default_rng(0), GreenhouseEnv(bank=bank, action="joint")
    checked = touched = wrong = 0
    for episode in range(episodes):
        env.reset(seed=episode, options={"scene": names[episode % len(names)]})
        compiled = compile_scene(env.scene, env.robot)
        checker = CollisionChecker(planning_model(compiled, env.target, margin=0.0))
        for configurations, collided in substeps(env, random):
            free = [checker.is_free(q) for q in configurations]
            checked += len(free)
            touched += free.count(False)
            wrong += all(free) == collided
    return checked, touched, wrong


def substeps(env: GreenhouseEnv, random: np.random.Generator) -> Iterator[tuple[np.ndarray, bool]]:
    """The configurations at the ends of the physics steps of each action, and the simulator's verdict on them."""
    import mujoco

    compiled = compile_scene(env.scene, env.robot)  # position servos, told where to be in every physics step
    model = copy.copy(compiled.model)
    compiled.allow_cup_on(model, env.target)
    data = mujoco.MjData(model)
    data.qpos[:] = data.ctrl[:] = env.start
    drift, last = random.uniform(-1, 1, 6), env.start
    drift[1] = abs(drift[1])  # towards the plants
    for _ in range(60):
        *_, terminated, truncated, info = env.step(drift + random.uniform(-0.4, 0.4, 6))
        command, configurations = env.simulation.command[0].copy(), []
        for k in range(5):
            data.ctrl[:] = last + (command - last) * ((k + 1) / 5)
            mujoco.mj_step(model, data)
            configurations.append(data.qpos.copy())
        last = command
        np.testing.assert_allclose(configurations[-1], env.simulation.state.joints[0], atol=1e-9)
        yield np.array(configurations), info["collision"]
        if terminated or truncated:
            return


def disagreements_at_random(bank: SceneBank, count: int, names: list[str]) -> tuple[int, int]:
    """Collisions and disagreements over random configurations, as starts of episodes."""
    random, env = np.random.default_rng(1), GreenhouseEnv(bank=bank, action="joint")
    touched = wrong = 0
    for name in names:
        env.reset(seed=0, options={"scene": name, "target": 0})
        checker = CollisionChecker(planning_model(compile_scene(env.scene, env.robot), 0, margin=0.0))
        for q in random.uniform(env.robot.lower, env.robot.upper, (count // len(names), 6)):
            _, info = env.reset(options={"scene": name, "target": 0, "start": q})
            free = checker.is_free(q)
            touched += not free
            wrong += free == info["collision"]
    return touched, wrong


def with_targets(bank: SceneBank) -> list[str]:
    """Names of the scenes in which something can be reached; foliage can leave none."""
    return [scene.name for scene in bank if any(target.difficulty != "unreachable" for target in scene.targets)]


def test_simulator_and_planner_agree() -> None:
    bank = SceneBank.open("mini")
    checked, touched, wrong = disagreements_on_the_way(bank, 40, bank.names())
    assert wrong == 0
    assert touched > 10
    assert checked > 2000
    touched, wrong = disagreements_at_random(bank, 400, bank.names())
    assert wrong == 0
    assert touched > 50


def test_simulator_and_planner_agree_on_ellipsoids(tmp_path: Path) -> None:
    """Scenes take turns in one padded model, so geoms change their types from reset to reset."""
    scenes = [scene for k in range(3) for scene in (make_scene(k), with_ellipsoids(make_scene(k), k))]
    bank = write_bank(tmp_path, [(scene, "train") for scene in scenes], name="ellipsoids")
    _, touched, wrong = disagreements_on_the_way(bank, 18, bank.names())
    assert wrong == 0
    assert touched > 5
    touched, wrong = disagreements_at_random(bank, 300, bank.names())
    assert wrong == 0
    assert touched > 50


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_simulator_and_planner_agree_everywhere() -> None:
    bank = SceneBank.open("default")
    assert disagreements_on_the_way(bank, 2000, with_targets(bank))[2] == 0
    assert disagreements_at_random(bank, 100_000, with_targets(bank))[1] == 0
