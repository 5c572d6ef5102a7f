from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from reach_helpers import REACH, scene_of, tool_at

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.envs import GreenhouseEnv, Randomization
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.scene import SceneBank


def goal_env(bank: SceneBank, **keywords: Any) -> GreenhouseEnv:
    return GreenhouseEnv(bank=bank, observation="goal", **keywords)


def rollout(env: GreenhouseEnv, episodes: int = 6) -> list[tuple[Any, ...]]:
    random, steps = np.random.default_rng(0), []
    for seed in range(episodes):
        env.reset(seed=seed)
        drift, over = random.uniform(-1, 1, 6), False
        drift[1] = 0.7
        while not over:
            steps.append(env.step(drift))
            over = steps[-1][2] or steps[-1][3] or len(steps) % 40 == 0
    return steps


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_the_contract_of_goal_environments_holds(bank: SceneBank, reward: str) -> None:
    """The interface of a GoalEnv of Gymnasium-Robotics."""
    env = goal_env(bank, reward=reward)
    assert isinstance(env.observation_space, spaces.Dict)
    assert set(env.observation_space.spaces) == {"observation", "achieved_goal", "desired_goal"}
    steps = rollout(env)
    assert any(step[4]["collision"] for step in steps)
    for observation, got, terminated, truncated, info in steps:
        goals = observation["achieved_goal"], observation["desired_goal"], info
        assert got == env.compute_reward(*goals)
        assert terminated == env.compute_terminated(*goals)
        assert truncated == env.compute_truncated(*goals)
    together = (
        np.array([step[0]["achieved_goal"] for step in steps]),
        np.array([step[0]["desired_goal"] for step in steps]),
        [step[4] for step in steps],
    )
    np.testing.assert_array_equal(env.compute_reward(*together), [step[1] for step in steps])
    np.testing.assert_array_equal(env.compute_terminated(*together), [step[2] for step in steps])


def test_a_goal_environment_may_tell_the_waypoint_too(bank: SceneBank) -> None:
    plain, waypoint, guided = (
        GreenhouseEnv(bank=bank, observation=kind).reset(seed=3)[0] for kind in ("goal", "roadmap", "goal_roadmap")
    )
    assert set(plain) == set(guided)
    size = len(plain["observation"])
    np.testing.assert_array_equal(guided["observation"][:size], plain["observation"])
    np.testing.assert_array_equal(guided["observation"][size:], waypoint[-(2 * 6 + 2) :])
    for goal in ("achieved_goal", "desired_goal"):
        np.testing.assert_array_equal(guided[goal], plain[goal])


def test_another_goal_changes_success_but_no_collision(bank: SceneBank) -> None:
    env = goal_env(bank, reward="sparse")
    for observation, _, _, _, info in rollout(env):
        here = observation["achieved_goal"]
        assert env.compute_reward(here, here, info) == (-1 if info["collision"] else 1)
        assert env.compute_reward(here, here + 0.03, info) == (-1 if info["collision"] else 0)


def test_the_observation_part_knows_nothing_of_the_target() -> None:
    tip, frame = tool_at(REACH)
    placed = scene_of(
        [Tomato(Sphere(tip + 0.2 * frame[:, 2] + [0, 0.1 * k, 0], 0.02 + 0.01 * k), truss=0) for k in range(2)]
    )
    env = goal_env(_bank_of(placed))
    seen = [env.reset(options={"scene": placed, "target": k, "start": REACH})[0] for k in (0, 1)]
    np.testing.assert_array_equal(seen[0]["observation"], seen[1]["observation"])
    np.testing.assert_allclose(seen[0]["desired_goal"], placed.tomatoes[0].center - [0, 0, 1.1 - 0.1625], atol=1e-6)
    assert not np.array_equal(seen[0]["desired_goal"], seen[1]["desired_goal"])


def test_goals_that_are_not_what_counts_are_refused(bank: SceneBank) -> None:
    with pytest.raises(InvalidValueError, match="truth"):
        goal_env(bank, physics="truth")
    with pytest.raises(InvalidValueError, match="target_position"):
        goal_env(bank, randomization=Randomization(target_position=0.01))


def test_an_info_without_the_collision_is_refused(bank: SceneBank) -> None:
    env = goal_env(bank)
    observation, info = env.reset(seed=0)
    for incomplete in (None, {}, [None], [{}], info):
        with pytest.raises(InvalidValueError, match="copy_info_dict"):
            env.compute_reward(observation["achieved_goal"], observation["desired_goal"], incomplete)
    for count in (0, 2):
        with pytest.raises(InvalidValueError, match=f"each of 1 goals, got {count}"):
            env.compute_reward(observation["achieved_goal"], observation["desired_goal"], [info] * count)


def test_hindsight_replay_relabels_with_collisions_kept(bank: SceneBank) -> None:
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import SAC, HerReplayBuffer

    from greenhouse_gym.learning.sb3 import make_sb3_vec_env

    env = make_sb3_vec_env(2, bank=bank, observation="goal", reward="sparse", seed=0)
    model = SAC(
        "MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, learning_starts=400, train_freq=50,
        replay_buffer_kwargs={"copy_info_dict": True, "n_sampled_goal": 4}, buffer_size=2000, batch_size=64, seed=0,
        device="cpu", policy_kwargs={"net_arch": [16]},
    )  # fmt: skip
    model.learn(600)
    batch = model.replay_buffer.sample(2000)
    rewards = batch.rewards.numpy().ravel()
    assert set(np.unique(rewards)) == {-1.0, 0.0, 1.0}  # relabeled successes, and crashes still
    at_goal = np.linalg.norm(batch.next_observations["achieved_goal"] - batch.next_observations["desired_goal"], axis=1)
    assert ((rewards == 1) <= (at_goal < 0.0201)).all()
    single = gymnasium.make("TomatoReach-v0", bank=bank, observation="goal", disable_env_checker=True)
    assert single.observation_space == model.observation_space


def _bank_of(scene: Any) -> SceneBank:
    import tempfile

    from greenhouse_gym.scene.bank import write_bank

    with tempfile.TemporaryDirectory() as folder:
        return write_bank(folder, [(scene, "train")], name="one")
