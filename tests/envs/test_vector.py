from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from greenhouse_gym.envs import TomatoReachEnv, TomatoReachVectorEnv
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.scene import SceneBank

COUNT, STEPS = 5, 230
KEYS = ("is_success", "collision", "contact", "distance", "clearance", "scene", "target", "difficulty")


def actions_towards_trouble(seed: int) -> np.ndarray:
    """(STEPS, COUNT, 6): most simulations crash now and then, the first runs into the step limit."""
    random = np.random.default_rng(seed)
    drift = random.uniform(-1, 1, (STEPS // 20 + 1, COUNT, 6)).repeat(20, axis=0)[:STEPS]
    drift[..., 1] = 0.7
    actions = drift + random.uniform(-0.2, 0.2, (STEPS, COUNT, 6))
    actions[:, 0] = 0.0
    return actions.astype(np.float32)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_vector_equals_single_environments_bit_for_bit(bank: SceneBank, mode: str) -> None:
    venv = gymnasium.make_vec("TomatoReach-v0", num_envs=COUNT, bank=bank, autoreset_mode=mode)
    singles = [TomatoReachEnv(bank=bank) for _ in range(COUNT)]
    observations, infos = venv.reset(seed=7)
    begun = [env.reset(seed=7 + i) for i, env in enumerate(singles)]
    np.testing.assert_array_equal(observations, [observation for observation, _ in begun])
    assert_infos(infos, [info for _, info in begun])
    ended, ends = [False] * COUNT, 0
    for actions in actions_towards_trouble(0):
        observations, rewards, terminated, truncated, infos = venv.step(actions)
        for i, env in enumerate(singles):
            if mode == "NextStep" and ended[i]:
                observation, info = env.reset()
                expected: tuple[Any, ...] = (observation, 0.0, False, False, info)
            else:
                expected = env.step(actions[i])
            ended[i] = expected[2] or expected[3]
            ends += ended[i]
            observation, info = expected[0], expected[4]
            if mode == "SameStep" and ended[i]:
                np.testing.assert_array_equal(infos["final_obs"][i], observation)
                assert_info(infos["final_info"], i, info)
                observation, info = env.reset()
            np.testing.assert_array_equal(observations[i], observation)
            assert (rewards[i], terminated[i], truncated[i]) == expected[1:4]
            assert_info(infos, i, info)
        if mode == "SameStep":
            assert ("final_obs" in infos) == any(ended)
            if any(ended):
                assert infos["_final_obs"].tolist() == infos["_final_info"].tolist() == ended
    assert ends > 10


def assert_infos(infos: dict[str, Any], expected: list[dict[str, Any]]) -> None:
    for i, info in enumerate(expected):
        assert_info(infos, i, info)


def assert_info(infos: dict[str, Any], i: int, expected: dict[str, Any]) -> None:
    assert set(expected) - {"reward_terms"} == set(KEYS)
    for key in KEYS:
        assert infos[f"_{key}"][i]
        assert infos[key][i] == expected[key], key
    if "reward_terms" in expected and "reward_terms" in infos:
        for name, value in expected["reward_terms"].items():
            assert infos["reward_terms"][name][i] == value


def test_threads_do_not_change_the_numbers(bank: SceneBank) -> None:
    results = []
    for threads in (1, 2):
        venv = TomatoReachVectorEnv(COUNT, bank=bank, threads=threads)
        venv.reset(seed=1)
        results.append([venv.step(actions)[:4] for actions in actions_towards_trouble(1)[:60]])
    for one, two in zip(*results, strict=True):
        for a, b in zip(one, two, strict=True):
            np.testing.assert_array_equal(a, b)


def test_returned_arrays_are_the_callers(bank: SceneBank) -> None:
    venv = TomatoReachVectorEnv(COUNT, bank=bank)
    venv.reset(seed=1)
    kept = venv.step(actions_towards_trouble(0)[0])
    copies = [kept[0].copy(), kept[1].copy(), kept[4]["distance"].copy()]
    for actions in actions_towards_trouble(0)[1:10]:
        venv.step(actions)
    for mine, copy in zip((kept[0], kept[1], kept[4]["distance"]), copies, strict=True):
        np.testing.assert_array_equal(mine, copy)


def test_spaces_and_metadata_are_standard(bank: SceneBank) -> None:
    venv = gymnasium.make_vec("TomatoReach-v0", num_envs=3, bank=bank)
    assert isinstance(venv, TomatoReachVectorEnv)
    assert venv.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observations, _ = venv.reset(seed=0)
    assert venv.observation_space.contains(observations)
    assert venv.action_space.sample().shape == (3, 6)
    single = TomatoReachEnv(bank=bank)
    assert venv.single_observation_space == single.observation_space
    assert venv.single_action_space == single.action_space


def test_without_autoreset_the_caller_resets_by_mask(bank: SceneBank) -> None:
    venv = TomatoReachVectorEnv(2, bank=bank, autoreset_mode=AutoresetMode.DISABLED)
    venv.reset(seed=0)
    for _ in range(200):
        *_, terminated, truncated, _ = venv.step(np.zeros((2, 6)))
    assert truncated.all()
    assert not terminated.any()
    with pytest.raises(InvalidValueError, match=r"\[0, 1\]"):
        venv.step(np.zeros((2, 6)))
    venv.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(InvalidValueError, match=r"\[1\]"):
        venv.step(np.zeros((2, 6)))
    _, infos = venv.reset(options={"reset_mask": np.array([False, True])})
    assert infos["_scene"].tolist() == [False, True]
    venv.step(np.zeros((2, 6)))


@pytest.mark.parametrize("mask", [np.array([1, 0]), np.zeros(2, dtype=bool), np.ones(3, dtype=bool)])
def test_a_bad_reset_mask_is_refused(bank: SceneBank, mask: Any) -> None:
    venv = TomatoReachVectorEnv(2, bank=bank)
    with pytest.raises(RuntimeError, match="reset"):  # the others would have no episode
        venv.reset(options={"reset_mask": [True, False]})
    venv.reset(seed=0)
    venv.reset(options={"reset_mask": [True, False]})
    with pytest.raises(InvalidValueError, match="reset_mask"):
        venv.reset(options={"reset_mask": mask})


def test_hostile_arguments(bank: SceneBank) -> None:
    with pytest.raises(UnknownNameError, match="NextStep"):
        TomatoReachVectorEnv(2, bank=bank, autoreset_mode="Never")
    with pytest.raises(InvalidValueError, match="num_envs"):
        TomatoReachVectorEnv(0, bank=bank)
    venv = TomatoReachVectorEnv(2, bank=bank)
    with pytest.raises(InvalidValueError, match="seeds"):
        venv.reset(seed=[1, 2, 3])
    venv.reset(seed=[1, None])
    for bad in (np.zeros((3, 6)), np.full((2, 6), np.nan)):
        with pytest.raises(InvalidValueError):
            venv.step(bad)


def test_a_refused_action_changes_nothing(bank: SceneBank) -> None:
    one, two = (TomatoReachVectorEnv(2, bank=bank) for _ in range(2))
    one.reset(seed=3), two.reset(seed=3)
    with pytest.raises(InvalidValueError):
        one.step(np.full((2, 6), np.inf))
    action = np.full((2, 6), 0.3)
    np.testing.assert_array_equal(one.step(action)[0], two.step(action)[0])
