from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import VecNormalize

from greenhouse_gym.agents import Agent, PolicyAgent, Problem
from greenhouse_gym.envs import GreenhouseEnv
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.learning.policies import save_policy
from greenhouse_gym.learning.sb3 import Sb3Agent, make_sb3_vec_env
from greenhouse_gym.scene import SceneBank


def test_episodes_end_with_everything_stable_baselines_reads(bank: SceneBank) -> None:
    env = make_sb3_vec_env(4, bank=bank, seed=3)
    observations = env.reset()
    single = GreenhouseEnv(bank=bank)
    expected, _ = single.reset(seed=3)
    np.testing.assert_array_equal(observations[0], expected)
    total, ended = 0.0, 0
    actions = np.zeros((4, 6), dtype=np.float32)
    actions[1:, 0] = 1.0  # the first stands still until truncated, the others drive into the plants
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
            assert sum(info["episode_terms"].values()) == pytest.approx(info["episode"]["r"], abs=1e-3)
    assert dones[0]
    assert infos[0]["TimeLimit.truncated"]
    assert infos[0]["is_success"] is False
    np.testing.assert_array_equal(infos[0]["terminal_observation"], expected)
    assert infos[0]["episode"] == pytest.approx({"r": total, "l": 200, "t": infos[0]["episode"]["t"]}, abs=1e-3)
    np.testing.assert_array_equal(observations[0], single.reset()[0])
    assert ended > 5


def test_warp_ends_episodes_as_mujoco_does(bank: SceneBank) -> None:
    pytest.importorskip("warp")
    envs = [make_sb3_vec_env(3, bank=bank, backend=backend, action="joint") for backend in ("warp", "mujoco")]
    warp, mujoco = envs
    names = warp.get_attr("scene_names")[0]
    warp.seed(1)
    first = warp.reset()
    mujoco.set_options(
        [{"scene": names[info["scene"]], "target": info["target"]} for info in warp.venv.reset_infos]
    )  # the same episodes, since the backends draw others
    np.testing.assert_allclose(first, mujoco.reset(), atol=1e-4)
    actions = np.zeros((3, 6), dtype=np.float32)
    actions[1:, 1] = 1.0  # the first stands still until truncated, the others fall into the plants
    running = np.ones(3, dtype=np.bool_)
    for _ in range(200):
        steps = [env.step(actions) for env in envs]
        assert (steps[0][2][running] == steps[1][2][running]).all()
        for i in np.flatnonzero(running & steps[0][2]):
            one, other = (step[3][i] for step in steps)
            accuracy = 0.2 if one["collision"] else 1e-3  # contacts push the arm in MuJoCo alone
            if not one["collision"]:
                np.testing.assert_allclose(one["terminal_observation"], other["terminal_observation"], atol=1e-4)
            assert one["episode_terms"] == pytest.approx(other["episode_terms"], abs=accuracy)
            assert one["reward_terms"] == pytest.approx(other["reward_terms"], abs=accuracy)
            for key in ("TimeLimit.truncated", "is_success", "collision", "steps"):
                assert one[key] == other[key]
        running &= ~steps[0][2]
    assert not running.any()


def test_a_model_of_warp_becomes_a_policy(bank: SceneBank, tmp_path: Path) -> None:
    pytest.importorskip("warp")
    env = make_sb3_vec_env(4, bank=bank, backend="warp", action="tip_velocity", seed=0)
    model = PPO("MlpPolicy", env, n_steps=4, batch_size=16, n_epochs=1, seed=0).learn(16)
    agents = [PolicyAgent.load(save_policy(model, tmp_path / "policy")), Sb3Agent(model)]
    assert all(agent.env_options["action"] == "tip_velocity" for agent in agents)
    one, other = (evaluate(agent, episodes=2, bank=bank, progress=False) for agent in agents)
    assert [record.steps for record in one.records] == [record.steps for record in other.records]


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


def test_any_model_is_an_agent(bank: SceneBank) -> None:
    """Of the native environment, of a single one, of images, with normalized observations; alone and many at once."""
    native = make_sb3_vec_env(2, bank=bank, seed=0)
    single = gymnasium.make("TomatoReach-v0", bank=bank)
    images = make_sb3_vec_env(2, bank=bank, seed=0, observation="points")
    normalized = VecNormalize(make_sb3_vec_env(2, bank=bank, seed=0))
    networks: list[dict[str, Any]] = [{"net_arch": [8]} for _ in range(4)]  # models write into them
    models = [
        PPO("MlpPolicy", native, n_steps=32, policy_kwargs=networks[0], seed=0),
        SAC("MlpPolicy", single, buffer_size=10, policy_kwargs=networks[1], seed=0),
        PPO("MultiInputPolicy", images, n_steps=32, policy_kwargs=networks[2], seed=0),
        PPO("MlpPolicy", normalized, n_steps=32, policy_kwargs=networks[3], seed=0),
    ]
    for model in models:
        agent = Sb3Agent(model)
        assert isinstance(agent, Agent)
        assert agent.name == type(model).__name__
        one, many = (evaluate(agent, episodes=2, bank=bank, num_envs=n, physics="reconstruction") for n in (1, 2))
        assert one.failures == many.failures == 0
        assert [(r.scene, r.target) for r in one.records] == [(r.scene, r.target) for r in many.records]
        np.testing.assert_allclose([r.distance for r in one.records], [r.distance for r in many.records], atol=0.02)
    assert Sb3Agent(models[2]).env_options["observation"] == "points"
    assert Sb3Agent(models[0], name="mine", env_options={"robot": "iiwa14"}).env_options == {"robot": "iiwa14"}


def test_models_with_a_memory_forget_between_episodes() -> None:
    class Recurrent:
        """The part of sb3-contrib's RecurrentPPO that the agent uses."""

        policy = type("Policy", (), {"lstm_actor": None})()

        def __init__(self) -> None:
            self.told: list[tuple[int | None, bool]] = []

        def get_env(self) -> None:
            return None

        get_vec_normalize_env = get_env

        def predict(self, seen: Any, state: int | None, first: Any, deterministic: bool) -> tuple[Any, int]:
            self.told.append((state, bool(first[0])))
            return np.zeros(6), (state or 0) + 1

    model = Recurrent()
    agent = Sb3Agent(model, env_options={})
    assert not hasattr(agent, "act_many")
    problem = Problem(*(None,) * 4)  # type: ignore[arg-type]
    for _ in range(2):
        agent.reset(problem)
        agent.act(np.zeros(72))
        agent.act(np.zeros(72))
    assert model.told == [(None, True), (1, False)] * 2
    assert copy.deepcopy(agent).model is model


def test_every_simulation_gets_its_own_options(bank: SceneBank) -> None:
    env = make_sb3_vec_env(3, bank=bank)
    scenes = bank.names()[:3]
    env.set_options([{"scene": name, "target": k} for k, name in enumerate(scenes)])
    env.reset()
    assert [info["scene"] for info in env.venv.reset_infos] == scenes
    assert [info["target"] for info in env.venv.reset_infos] == [0, 1, 2]
    env.set_options({"scene": scenes[2]})
    env.reset()
    assert {info["scene"] for info in env.venv.reset_infos} == {scenes[2]}


def test_some_of_the_simulations_cannot_be_changed_alone(bank: SceneBank) -> None:
    env = make_sb3_vec_env(3, bank=bank, observation="goal")
    env.env_method("set_difficulty", "easy")
    env.env_method("set_difficulty", "easy", indices=[2, 0, 1])
    with pytest.raises(InvalidValueError, match=r"'set_difficulty'.*all 3 simulations.*\[1\]"):
        env.env_method("set_difficulty", "hard", indices=[1])
    with pytest.raises(InvalidValueError, match="attribute 'render_mode'"):
        env.set_attr("render_mode", None, indices=0)
    assert env.get_attr("render_mode", indices=[0, 2]) == [None, None]
    observed = env.reset()
    env.step(np.zeros((3, 6)))
    infos = env.step(np.zeros((3, 6)))[3]
    goals = (observed["achieved_goal"], observed["desired_goal"], infos)
    assert env.env_method("compute_reward", *goals, indices=[0])[0].shape == (3,)
