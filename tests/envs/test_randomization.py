from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.envs import GreenhouseEnv, PlantMotion, Randomization
from greenhouse_gym.envs.randomization import NO_RANDOMIZATION
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.scene import SceneBank, Shapes
from greenhouse_gym.scene.bank import write_bank


def first(bank: SceneBank, seed: int = 0, **settings: Any) -> tuple[GreenhouseEnv, np.ndarray]:
    env = GreenhouseEnv(bank=bank, randomization=Randomization(**settings))
    return env, env.reset(seed=seed, options={"scene": "made-up-0", "target": 0})[0]


def test_off_is_the_same_as_none(bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank)
    np.testing.assert_array_equal(first(bank)[1], env.reset(seed=0, options={"scene": "made-up-0", "target": 0})[0])


def test_encoders_are_off_while_the_arm_stands_where_it_is_told(bank: SceneBank) -> None:
    env, observed = first(bank, joint_offset=0.05)
    offset = observed[:6] - env.start
    assert 0.001 < np.abs(offset).max() <= 0.05
    np.testing.assert_allclose(env.model_and_data()[1].qpos, env.start)
    np.testing.assert_allclose(observed[6:], first(bank)[1][6:], atol=1e-6)
    np.testing.assert_array_equal(observed, first(bank, joint_offset=0.05)[1])
    assert not np.array_equal(observed, first(bank, seed=1, joint_offset=0.05)[1])


def test_the_told_target_is_off_and_the_true_one_counts(bank: SceneBank) -> None:
    env, observed = first(bank, target_position=0.03)
    _, true = first(bank)
    error = observed[27:30] - true[27:30]
    assert 0.001 < np.abs(error).max() <= 0.03
    np.testing.assert_allclose(observed[24:27] - true[24:27], error, atol=1e-6)
    assert env.step(np.zeros(6))[4]["distance"] == first(bank)[0].step(np.zeros(6))[4]["distance"]


def test_the_base_stands_elsewhere_and_physics_and_positions_follow(bank: SceneBank) -> None:
    env, observed = first(bank, base_position=0.05, base_yaw=0.2)
    model, data = env.model_and_data()
    still = first(bank)[0].model_and_data()[0]
    shift = model.body_pos[1] - still.body_pos[1]
    yaw = 2 * np.arctan2(model.body_quat[1, 3], model.body_quat[1, 0])
    assert 0.001 < np.abs(shift[:2]).max() <= 0.05
    assert 0.001 < abs(yaw) <= 0.2
    tip = data.site_xpos[model.site("tip").id]
    tool = data.site_xmat[model.site("tip").id].reshape(3, 3)[:, 2]
    tomato = env.scene.tomatoes[0]
    np.testing.assert_allclose(observed[24:27], tomato.center - tip - tomato.radius * tool, atol=1e-6)
    # every episode is displaced from where the stand is
    env.reset(seed=1, options={"scene": "made-up-0", "target": 0})
    moved = env.model_and_data()[0].body_pos[1] - still.body_pos[1]
    assert np.abs(moved[:2]).max() <= 0.05
    assert not np.array_equal(moved, shift)


@pytest.mark.parametrize("settings", [{"base_position": -0.1}, {"joint_offset": np.nan}])
def test_impossible_sizes_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(InvalidValueError, match=next(iter(settings))):
        Randomization(**settings)


def test_plants_move_in_the_truth_and_nobody_is_told(bank: SceneBank, tmp_path: Path) -> None:
    scenes = [
        scene.model_copy(update={"truth": Shapes(tomatoes=scene.tomatoes, stems=scene.stems, clutter=scene.clutter)})
        for scene in bank
    ]
    true = write_bank(tmp_path, [(scene, bank.split_of(scene.name)) for scene in scenes], name="true")
    moving = Randomization(plants=PlantMotion(truss_turn=0.3))
    still, env, again = (
        GreenhouseEnv(bank=true, physics="truth", randomization=randomization)
        for randomization in (NO_RANDOMIZATION, moving, moving)
    )
    (seen, observed), (same, info), (_, twice) = (each.reset(seed=5) for each in (still, env, again))
    np.testing.assert_array_equal(seen, same)
    assert observed["scene"] == info["scene"]
    assert info["distance"] != pytest.approx(observed["distance"], abs=1e-4)
    assert info["distance"] == twice["distance"]
    goals = []
    for _ in range(4):
        env.reset(options={"scene": true.names("train")[0], "target": 0})
        goals.append(env.simulation.goal(0).tolist())
        model, _ = env.simulation.model_and_data(0)
        assert np.abs(model.geom_pos - goals[-1]).max(axis=1).min() < 1e-7
        env.step(env.action_space.sample())
    assert len({tuple(goal) for goal in goals}) == 4
    with pytest.raises(InvalidValueError, match="truth"):
        GreenhouseEnv(bank=true, randomization=moving)
    with pytest.raises(InvalidValueError, match="PlantMotion"):
        Randomization(plants=0.1)  # type: ignore[arg-type]
