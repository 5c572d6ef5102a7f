from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from greenhouse_gym.envs import TomatoReachEnv
from greenhouse_gym.integrations.sb3 import make_sb3_vec_env
from greenhouse_gym.scene import SceneBank


def test_episodes_end_with_everything_stable_baselines_reads(bank: SceneBank) -> None:
    env = make_sb3_vec_env(4, bank=bank, seed=3)
    observations = env.reset()
    single = TomatoReachEnv(bank=bank)
    expected, _ = single.reset(seed=3)
    np.testing.assert_array_equal(observations[0], expected)
    total, ended = 0.0, 0
    actions = np.zeros((4, 6), dtype=np.float32)
    actions[1:, 1] = 1.0  # the first stands still until truncated, the others fall into the plants
    for step in range(1, 201):
        observations, rewards, dones, infos = env.step(actions)
        expected, reward, *_ = single.step(actions[0])
        total += reward
        assert all(bool(info) == bool(done) for info, done in zip(infos, dones, strict=True))
        for i in np.flatnonzero(dones):
            ended += 1
            info = infos[i]
            assert info["TimeLimit.truncated"] == (not info["collision"] and not info["is_success"])
            assert env.observation_space.contains(info["terminal_observation"])
            assert info["episode"]["l"] <= step
            assert sum(info["reward_terms"].values()) == pytest.approx(rewards[i], rel=1e-6)
    assert dones[0]
    assert infos[0]["TimeLimit.truncated"]
    assert infos[0]["is_success"] is False
    np.testing.assert_array_equal(infos[0]["terminal_observation"], expected)
    assert infos[0]["episode"] == pytest.approx({"r": total, "l": 200, "t": infos[0]["episode"]["t"]}, abs=1e-3)
    np.testing.assert_array_equal(observations[0], single.reset()[0])
    assert ended > 5


def test_seeding_again_repeats_the_episodes(bank: SceneBank) -> None:
    env = make_sb3_vec_env(3, bank=bank, seed=5)
    first = env.reset()
    other = env.reset()
    env.seed(5)
    np.testing.assert_array_equal(env.reset(), first)
    assert not np.array_equal(first, other)


def test_attributes_and_methods_reach_the_environment(bank: SceneBank) -> None:
    env = make_sb3_vec_env(2, bank=bank)
    assert env.get_attr("num_envs") == [2, 2]
    assert env.has_attr("simulation")
    assert not env.has_attr("nonsense")
    assert env.env_is_wrapped(object) == [False, False]
    with pytest.raises(TypeError):
        make_sb3_vec_env(2, bank=bank, colour="red")
