from __future__ import annotations

import subprocess
import sys

import gymnasium
import numpy as np
import pytest

pytest.importorskip("warp")

import greenhouse_gym  # noqa: F401
from greenhouse_gym.envs import DenseReward, EpisodeSampler, Randomization
from greenhouse_gym.envs.warp import RATINGS, WarpVectorEnv
from greenhouse_gym.envs.warp.bank import draw_table
from greenhouse_gym.errors import InvalidValueError, NoEpisodeError, UnknownKeywordError, UnknownNameError
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import SceneBank


def make(count, **settings):
    return gymnasium.make_vec("TomatoReach-v0", num_envs=count, backend="warp", **{"bank": "mini", **settings})


def random_actions(steps, count, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, count, 6)).astype(np.float32)


@pytest.fixture(scope="module")
def env():
    return make(8)


def test_spaces_and_types(env):
    mujoco = gymnasium.make_vec("TomatoReach-v0", num_envs=8, bank="mini")
    assert env.observation_space == mujoco.observation_space
    assert env.action_space == mujoco.action_space
    observation, info = env.reset(seed=0)
    assert observation in env.observation_space
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert observation in env.observation_space
    assert reward.shape == (8,)
    assert terminated.dtype == truncated.dtype == np.bool_
    assert info["contact"].shape == (8, 2)
    assert info["_contact"].all()
    assert np.allclose(sum(info["reward_terms"].values()), reward, atol=1e-6)
    assert all(RATINGS[k] in ("easy", "medium", "hard") for k in info["difficulty"])
    assert {env.unwrapped.scene_names[k] for k in info["scene"]} <= set(SceneBank.open("mini").names("train"))
    mujoco.close()


def test_same_seed_same_numbers_for_any_number_of_simulations(env):
    few = make(3)
    actions = random_actions(40, 8)
    one, other = [], []
    for vector, results in ((env, one), (few, other)):
        observation, _ = vector.reset(seed=5)
        results.append(observation[:3])
        for action in actions[:, : vector.num_envs]:
            observation, reward, *_ = vector.step(action)
            results.append(np.column_stack([observation, reward])[:3])
    assert all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))
    again, _ = few.reset(seed=6)
    assert np.array_equal(again[:2], few.reset(seed=[6, 7, 9])[0][:2])
    assert not np.array_equal(again, other[0])
    assert not np.array_equal(again, few.reset()[0])  # the next episodes of the same seed


def test_returned_arrays_do_not_change(env):
    observation, info = env.reset(seed=0)
    kept, distance = observation.copy(), info["distance"].copy()
    env.step(np.ones((8, 6)))
    assert np.array_equal(observation, kept)
    assert np.array_equal(info["distance"], distance)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_autoreset(mode):
    env = make(6, step_limit=5, autoreset_mode=mode)
    first, _ = env.reset(seed=0)
    ready = first[:, :6]
    for step in range(1, 13):
        observation, reward, _, truncated, info = env.step(np.full((6, 6), 0.1))
        at_start = np.allclose(observation[:, :6], ready)
        if mode == "NextStep":  # five steps, and one that resets
            assert truncated.all() == (step % 6 == 5)
            assert at_start == (step % 6 == 0)
            assert (reward == 0).all() == (step % 6 == 0)
            assert (info["steps"] == step % 6).all()
        else:
            assert truncated.all() == at_start == (step % 5 == 0)
            assert (info["_final_obs"] == truncated).all()
            assert (info["steps"] == step % 5).all()
            if truncated.all():
                assert not np.allclose(info["final_obs"][:, :6], ready)
                assert (info["final_info"]["steps"] == 5).all()


def test_reset_options(env):
    bank = SceneBank.open("mini")
    name = bank.names("train")[1]
    start = get_robot("ur5e").starts["folded"]
    _, info = env.reset(options={"scene": name, "target": 2, "start": "folded"})
    assert (info["target"] == 2).all()
    assert (info["scene"] == env.unwrapped.scene_names.index(name)).all()
    mask = np.arange(8) < 3
    observation, info = env.reset(seed=1, options={"reset_mask": mask, "scene": name, "target": 0, "start": start})
    assert info["target"].tolist() == [0] * 3 + [2] * 5
    assert np.allclose(observation[:, :6], start)
    observation, _ = env.reset(seed=1)
    assert np.allclose(observation[:, :6], get_robot("ur5e").start)  # the chosen start was for one episode
    _, info = env.reset(options={"difficulty": "easy"})
    assert (info["difficulty"] == RATINGS.index("easy")).all()
    for options, message in (
        ({"scene": "nowhere"}, "nowhere"),
        ({"scene": bank.names("test")[0]}, "split"),
        ({"scene": name, "target": 10_000}, "10000"),
        ({"reset_mask": [True]}, "reset_mask"),
    ):
        with pytest.raises((InvalidValueError, UnknownNameError), match=message):
            env.reset(options=options)


def test_start_in_contact_collides_at_once(env):
    options = {"scene": SceneBank.open("mini").names("train")[0], "target": 0, "start": [0.0] * 6}  # into the plants
    mujoco = gymnasium.make_vec("TomatoReach-v0", num_envs=8, bank="mini")
    _, theirs = mujoco.reset(options=options)
    _, ours = env.reset(options=options)
    assert theirs["collision"].all()
    assert ours["collision"].all()
    _, reward, terminated, *_ = env.step(np.zeros((8, 6)))
    assert terminated.all()
    assert np.allclose(reward, mujoco.step(np.zeros((8, 6)))[1], atol=0.1)  # there, the contact also pushes the arm
    mujoco.close()


def test_draws_follow_the_weights():
    weighted = make(3000, difficulty={"easy": 3, "hard": 1}, split="train")
    _, info = weighted.reset(seed=0)
    assert (info["difficulty"] == 0).mean() == pytest.approx(0.75, abs=0.03)
    weighted.unwrapped.set_difficulty("medium")
    assert (weighted.reset(seed=0)[1]["difficulty"] == 1).all()
    bank = SceneBank.open("mini")
    sampler = EpisodeSampler(bank, "train", get_robot("ur5e"), ("easy", "hard"))
    scenes = [bank.scene(name) for name in bank.names("train")]
    first = np.cumsum([0] + [len(scene.tomatoes) for scene in scenes[:-1]])
    table = draw_table(scenes, sampler, first)
    assert table.cumulative[-1] == 1
    assert table.count.sum() == sum(len(sampler.fitting(scene, ("easy", "hard"))) for scene in scenes)


def test_one_scene_and_target(env):
    name = SceneBank.open("mini").names("train")[0]
    _, info = make(4, scene=name, target=1).reset(seed=0)
    assert (info["target"] == 1).all()
    with pytest.raises(InvalidValueError, match="split"):
        make(4, scene=SceneBank.open("mini").names("test")[0])


def test_tensors_are_views():
    torch = pytest.importorskip("torch")
    env = make(4, arrays="torch", reward=DenseReward(collision=-5.0))
    observation, _ = env.reset(seed=0)
    assert isinstance(observation, torch.Tensor)
    later, reward, terminated, *_ = env.step(torch.zeros(4, 6))
    assert later.data_ptr() == observation.data_ptr() == env.unwrapped.simulation.out.observation.ptr
    assert reward.dtype == torch.float32
    assert terminated.dtype == torch.bool
    with pytest.raises(InvalidValueError, match=r"\(4, 6\)"):
        env.step(torch.zeros(4, 5))
    env.step(torch.full((4, 6), torch.nan))
    assert torch.isfinite(env.step(torch.zeros(4, 6))[0]).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"observation": "depth"}, "state or goal"),
        ({"reward": "path"}, "dense, sparse"),
        ({"randomization": Randomization(base_yaw=0.1)}, "randomization"),
        ({"device": "cuda:77"}, "not available"),
        ({"device": "tpu"}, "Choices: cpu, cuda"),
        ({"render_mode": "rgb_array"}, "render_mode"),
        ({"autoreset_mode": "Disabled"}, "NextStep"),
        ({"precision": "float16"}, "float32"),
        ({"arrays": "jax"}, "numpy, torch"),
        ({"num_envs": 10**9}, "GB"),
        ({"num_envs": 0}, "num_envs"),
        ({"threads": 2}, "threads"),
        ({"backend": "jax"}, "mujoco, warp"),
    ],
)
def test_errors_name_the_way_out(settings, message):
    with pytest.raises((InvalidValueError, UnknownNameError, UnknownKeywordError), match=message):
        gymnasium.make_vec("TomatoReach-v0", **({"num_envs": 2, "backend": "warp", "bank": "mini"} | settings))


def test_wrong_use():
    env = WarpVectorEnv(2, bank="mini")
    with pytest.raises(NoEpisodeError, match="reset"):
        env.step(np.zeros((2, 6)))
    env.reset(seed=0)
    for actions, message in ((np.zeros((2, 5)), "shape"), (np.full((2, 6), np.nan), "finite"), ("up", "numbers")):
        with pytest.raises(InvalidValueError, match=message):
            env.step(actions)


def test_without_warp_the_message_names_the_extra():
    code = (
        "import sys, gymnasium, greenhouse_gym; sys.modules['warp'] = None\n"
        "gymnasium.make_vec('TomatoReach-v0', num_envs=2, backend='warp')"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "greenhouse-gym[warp]" in result.stderr
