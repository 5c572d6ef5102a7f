from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from greenhouse_gym.envs import GreenhouseEnv, GreenhouseVectorEnv, Randomization
from greenhouse_gym.envs.observations import select
from greenhouse_gym.errors import EpisodeOverError, InvalidValueError, UnknownNameError
from greenhouse_gym.scene import SceneBank

COUNT, STEPS = 5, 230


def actions_towards_trouble(seed: int) -> np.ndarray:
    """(STEPS, COUNT, 6): most simulations crash now and then, the first runs into the step limit."""
    random = np.random.default_rng(seed)
    drift = random.uniform(-1, 1, (STEPS // 20 + 1, COUNT, 6)).repeat(20, axis=0)[:STEPS]
    drift[..., 1] = 0.7
    actions = drift + random.uniform(-0.2, 0.2, (STEPS, COUNT, 6))
    actions[:, 0] = 0.0
    return actions.astype(np.float32)


def equal(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    return a.dtype == b.dtype and np.array_equal(a, b) if isinstance(a, np.ndarray) else bool(a == b)


def info_of(infos: dict[str, Any], i: int) -> dict[str, Any]:
    """One simulation's info, through the masks, as its single environment would give it."""
    result = {}
    for key, values in infos.items():
        if not key.startswith(("_", "final")) and infos[f"_{key}"][i]:
            if isinstance(values, dict):
                result[key] = info_of(values, i)
            else:
                result[key] = values[i] if values.dtype == object or values.ndim > 1 else values[i].item()
    return result


def compare_with_singles(
    count: int, steps: int, actions: Callable[[int], np.ndarray], mode: str, **keywords: Any
) -> int:
    """Step a vector environment and single ones, compare everything, and return the number of episodes ended."""
    venv = gymnasium.make_vec("TomatoReach-v0", num_envs=count, autoreset_mode=mode, **keywords)
    singles = [GreenhouseEnv(**{k: v for k, v in keywords.items() if k != "threads"}) for _ in range(count)]
    observations, infos = venv.reset(seed=7)
    for i, env in enumerate(singles):
        observation, info = env.reset(seed=7 + i)
        assert equal(select(observations, i), observation)
        assert equal(info_of(infos, i), info)
    ended, ends = [False] * count, 0
    for step in range(steps):
        action = actions(step)
        observations, rewards, terminated, truncated, infos = venv.step(action)
        for i, env in enumerate(singles):
            if mode == "NextStep" and ended[i]:
                observation, info = env.reset()
                expected: tuple[Any, ...] = (observation, 0.0, False, False, info)
            else:
                expected = env.step(action[i])
            ended[i] = expected[2] or expected[3]
            ends += ended[i]
            observation, info = expected[0], expected[4]
            if mode == "SameStep" and ended[i]:
                assert equal(infos["final_obs"][i], observation)
                assert equal(info_of(infos["final_info"], i), info)
                observation, info = env.reset()
            assert equal(select(observations, i), observation)
            assert (rewards[i], terminated[i], truncated[i]) == expected[1:4]
            assert equal(info_of(infos, i), info)
        if mode == "SameStep":
            assert ("final_obs" in infos) == any(ended)
            if any(ended):
                assert infos["_final_obs"].tolist() == infos["_final_info"].tolist() == ended
    venv.close()
    return ends


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_vector_equals_single_environments_bit_for_bit(bank: SceneBank, mode: str) -> None:
    actions = actions_towards_trouble(0)
    assert compare_with_singles(COUNT, STEPS, lambda step: actions[step], mode, bank=bank) > 10


ALL_OFF = Randomization(0.03, 0.05, 0.02, 0.01, depth_noise=True)


@pytest.mark.parametrize(
    "keywords",
    [
        {"robot": "iiwa14", "observation": "goal", "action": "tip_velocity", "reward": "sparse"},
        {"observation": "depth", "action": "joint_velocity", "randomization": ALL_OFF},
        {"observation": "roadmap", "randomization": Randomization(0.03, 0.05, 0.02, 0.01)},
        {"robot": "iiwa14", "observation": "roadmap", "action": "joint"},
        {"observation": "state", "reward": "path"},
        {"robot": "iiwa14", "observation": "points", "action": "joint", "difficulty": {"easy": 1, "hard": 0}},
    ],
)
def test_vector_equals_single_environments_whatever_the_kind(bank: SceneBank, keywords: dict[str, Any]) -> None:
    size = 7 if keywords.get("robot") == "iiwa14" and keywords.get("action") == "joint" else 6
    random = np.random.default_rng(1)
    drift = random.uniform(-1, 1, (3, size))

    def actions(step: int) -> np.ndarray:
        return drift + random.uniform(-0.3, 0.3, (3, size))

    assert compare_with_singles(3, 70, actions, "NextStep", bank=bank, **keywords) > 0


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("threads", [1, 2])
def test_64_simulations_equal_single_ones_over_2000_steps(threads: int) -> None:
    random = np.random.default_rng(threads)
    ends = compare_with_singles(
        64, 2000, lambda step: random.uniform(-1, 1, (64, 6)), "NextStep", bank="default", threads=threads
    )
    assert ends > 640


def test_asynchronous_workers_and_pickled_constructors(bank: SceneBank) -> None:
    import pickle
    from functools import partial

    constructor = partial(gymnasium.make, "greenhouse_gym:TomatoReach-v0", bank=str(bank.path), robot="iiwa14")
    constructor = pickle.loads(pickle.dumps(constructor))
    actions = np.random.default_rng(3).uniform(-1, 1, (5, 2, 6)).astype(np.float32)
    seen = []
    for make in (AsyncVectorEnv, SyncVectorEnv):
        venv = make([constructor] * 2, **({"context": "spawn"} if make is AsyncVectorEnv else {}))
        seen.append([venv.reset(seed=4)[0], *(venv.step(action)[0].copy() for action in actions)])
        venv.call("set_difficulty", "easy") if hasattr(venv, "call") else None
        venv.close()
    assert equal(np.array(seen[0]), np.array(seen[1]))


def test_difficulty_is_set_for_all_simulations_from_their_next_episode(bank: SceneBank) -> None:
    venv = GreenhouseVectorEnv(2, bank="default")
    venv.set_difficulty({"hard": 1.0})
    for _ in range(5):
        assert set(venv.reset()[1]["difficulty"]) == {"hard"}
    assert set(venv.reset(options={"difficulty": "easy"})[1]["difficulty"]) == {"easy"}
    with pytest.raises(UnknownNameError, match="unreachable"):
        venv.set_difficulty("impossible")
    assert set(venv.reset()[1]["difficulty"]) == {"hard"}  # as before the error


def test_closing_twice_is_fine_and_a_reset_opens_again(bank: SceneBank) -> None:
    venv = GreenhouseVectorEnv(2, bank=bank)
    first, _ = venv.reset(seed=1)
    venv.close()
    venv.close()
    with pytest.raises(RuntimeError, match="reset"):
        venv.step(np.zeros((2, 6)))
    np.testing.assert_array_equal(venv.reset(seed=1)[0], first)
    venv.step(np.zeros((2, 6)))


def test_threads_do_not_change_the_numbers(bank: SceneBank) -> None:
    results = []
    for threads in (1, 2):
        venv = GreenhouseVectorEnv(COUNT, bank=bank, threads=threads)
        venv.reset(seed=1)
        results.append([venv.step(actions)[:4] for actions in actions_towards_trouble(1)[:60]])
    for one, two in zip(*results, strict=True):
        for a, b in zip(one, two, strict=True):
            np.testing.assert_array_equal(a, b)


def test_returned_arrays_are_the_callers(bank: SceneBank) -> None:
    venv = GreenhouseVectorEnv(COUNT, bank=bank)
    venv.reset(seed=1)
    kept = venv.step(actions_towards_trouble(0)[0])
    copies = [kept[0].copy(), kept[1].copy(), kept[4]["distance"].copy()]
    for actions in actions_towards_trouble(0)[1:10]:
        venv.step(actions)
    for mine, copy in zip((kept[0], kept[1], kept[4]["distance"]), copies, strict=True):
        np.testing.assert_array_equal(mine, copy)


def test_spaces_and_metadata_are_standard(bank: SceneBank) -> None:
    venv = gymnasium.make_vec("TomatoReach-v0", num_envs=3, bank=bank)
    assert isinstance(venv, GreenhouseVectorEnv)
    assert venv.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observations, _ = venv.reset(seed=0)
    assert venv.observation_space.contains(observations)
    assert venv.action_space.sample().shape == (3, 6)
    single = GreenhouseEnv(bank=bank)
    assert venv.single_observation_space == single.observation_space
    assert venv.single_action_space == single.action_space


def test_without_autoreset_the_caller_resets_by_mask(bank: SceneBank) -> None:
    venv = GreenhouseVectorEnv(2, bank=bank, autoreset_mode=AutoresetMode.DISABLED)
    venv.reset(seed=0)
    for _ in range(200):
        *_, terminated, truncated, _ = venv.step(np.zeros((2, 6)))
    assert truncated.all()
    assert not terminated.any()
    with pytest.raises(EpisodeOverError, match=r"\[0, 1\]"):
        venv.step(np.zeros((2, 6)))
    venv.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(EpisodeOverError, match=r"\[1\]"):
        venv.step(np.zeros((2, 6)))
    _, infos = venv.reset(options={"reset_mask": np.array([False, True])})
    assert infos["_scene"].tolist() == [False, True]
    venv.step(np.zeros((2, 6)))


@pytest.mark.parametrize("mask", [np.array([1, 0]), np.zeros(2, dtype=bool), np.ones(3, dtype=bool)])
def test_a_bad_reset_mask_is_refused(bank: SceneBank, mask: Any) -> None:
    venv = GreenhouseVectorEnv(2, bank=bank)
    with pytest.raises(RuntimeError, match="reset"):  # the others would have no episode
        venv.reset(options={"reset_mask": [True, False]})
    venv.reset(seed=0)
    venv.reset(options={"reset_mask": [True, False]})
    with pytest.raises(InvalidValueError, match="reset_mask"):
        venv.reset(options={"reset_mask": mask})


def test_hostile_arguments(bank: SceneBank) -> None:
    with pytest.raises(UnknownNameError, match="NextStep"):
        GreenhouseVectorEnv(2, bank=bank, autoreset_mode="Never")
    with pytest.raises(InvalidValueError, match="num_envs"):
        GreenhouseVectorEnv(0, bank=bank)
    venv = GreenhouseVectorEnv(2, bank=bank)
    with pytest.raises(InvalidValueError, match="seeds"):
        venv.reset(seed=[1, 2, 3])
    venv.reset(seed=[1, None])
    for bad in (np.zeros((3, 6)), np.full((2, 6), np.nan)):
        with pytest.raises(InvalidValueError):
            venv.step(bad)


def test_a_refused_action_changes_nothing(bank: SceneBank) -> None:
    one, two = (GreenhouseVectorEnv(2, bank=bank) for _ in range(2))
    one.reset(seed=3), two.reset(seed=3)
    with pytest.raises(InvalidValueError):
        one.step(np.full((2, 6), np.inf))
    action = np.full((2, 6), 0.3)
    np.testing.assert_array_equal(one.step(action)[0], two.step(action)[0])
