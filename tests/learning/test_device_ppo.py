from __future__ import annotations

from dataclasses import replace
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("warp")
pytest.importorskip("torch")

from greenhouse_gym.agents import load_policy
from greenhouse_gym.agents.policy_agent import PolicyAgent
from greenhouse_gym.common.files import exclusive
from greenhouse_gym.envs.features import feature_slices
from greenhouse_gym.errors import DivergedError, FileWriteError, InvalidValueError
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.learning import DevicePpoSettings, PpoSettings, device_training, train_ppo, train_ppo_on_device
from greenhouse_gym.learning.device_ppo import DevicePpo
from greenhouse_gym.learning.training_files import CURVE, read_curve
from greenhouse_gym.motion.goal_options import goal_options
from greenhouse_gym.scene import SceneBank, compile_scene

SMALL = DevicePpoSettings(
    bank="mini", num_envs=32, rollout_steps=16, minibatches=4, epochs=2, total_steps=2048, hidden=(32, 32)
)


def test_policy_plays_in_mujoco(tmp_path):
    lines = []
    path = train_ppo_on_device(SMALL, tmp_path / "run", on_progress=lines.append)
    assert lines[-1]["steps"] == 2048
    last = read_curve(tmp_path / "run" / CURVE)[-1]
    assert (last["steps"], last["learning_rate"]) == (2048, SMALL.learning_rate / 4)  # of the last of four rollouts
    agent = PolicyAgent.load(path)
    assert agent.policy.training["steps"] == 2048
    result = evaluate(agent, "test", 2, bank="mini", progress=False)
    assert len(result.records) == 2
    with pytest.raises(InvalidValueError, match="another folder"):
        train_ppo_on_device(SMALL, tmp_path / "run")
    with pytest.raises(InvalidValueError, match="another folder"):
        train_ppo(PpoSettings(bank="mini"), tmp_path / "run")
    with exclusive(tmp_path / "other"), pytest.raises(FileWriteError, match="another process is at work"):
        train_ppo_on_device(SMALL, tmp_path / "other")


def test_same_seed_same_policy():
    weights = []
    for _ in range(2):
        training = DevicePpo(SMALL)
        training.iterate(1.0)
        weights.append(training.policy().weights)
    assert all(np.array_equal(a, b) for a, b in zip(*weights, strict=True))
    training.settings = replace(SMALL, divergence=1e-9)
    for expected in (1.0, 1 / 1.5):
        training.iterate(1.0)
        assert training.learning_rate == pytest.approx(SMALL.learning_rate * expected)


def test_interrupted_training_of_limited_time_leaves_a_policy(tmp_path, monkeypatch):
    rates = []

    def stop(line):
        rates.append(line["learning_rate"])
        raise KeyboardInterrupt

    ticks = count()
    monkeypatch.setattr(device_training, "time", SimpleNamespace(monotonic=lambda: float(next(ticks))))
    with pytest.raises(KeyboardInterrupt):
        train_ppo_on_device(replace(SMALL, total_steps=10**9), tmp_path / "run", time_limit=3.5, on_progress=stop)
    assert rates == [pytest.approx(SMALL.learning_rate * 0.5 / 3.5)]
    assert PolicyAgent.load(tmp_path / "run" / "policy").policy.training["algorithm"] == "PPO on a device"


def test_a_diverged_training_keeps_its_last_policy(tmp_path, monkeypatch):
    trainings = []

    class Known(DevicePpo):
        def __init__(self, settings):
            super().__init__(settings)
            trainings.append(self)

    def spoil(line):
        trainings[0].networks.log_std.data.fill_(float("nan"))

    monkeypatch.setattr(device_training, "DevicePpo", Known)
    monkeypatch.setattr(device_training, "_SECONDS_BETWEEN_LINES", 0.0)
    with pytest.raises(DivergedError, match=r"within 1,024 steps.*before is kept"):
        train_ppo_on_device(SMALL, tmp_path / "run", on_progress=spoil)
    assert PolicyAgent.load(tmp_path / "run" / "policy").policy.training["steps"] == 512
    assert [row["steps"] for row in read_curve(tmp_path / "run" / CURVE)] == [512]


def test_sizes_follow_the_device_and_sources_choose_the_rows():
    assert (DevicePpoSettings().num_envs, DevicePpoSettings().rollout_steps) == (512, 32)
    assert (DevicePpoSettings(device="cuda").num_envs, DevicePpoSettings(device="cuda").rollout_steps) == (4096, 24)
    assert DevicePpoSettings(num_envs=32).num_envs == 32
    assert (DevicePpoSettings().hidden, DevicePpoSettings(device="cuda").hidden) == ((128, 128), (256, 256))
    assert (DevicePpoSettings().epochs, DevicePpoSettings(device="cuda").epochs) == (2, 4)
    training = DevicePpo(replace(SMALL, sources=("own",), action="tip_velocity"))
    bank = training.env.simulation.sampler.bank
    assert {entry.source for entry in bank.manifest.scenes} == {"own"}
    assert training.policy().training["bank_sha256"] == SceneBank.open("mini").sha256


GOALS = replace(SMALL, action="joint", goals=3, log_std=-1.0)


def test_policies_that_choose_goals_begin_by_moving_straight_and_learn(tmp_path):
    training = DevicePpo(GOALS)
    policy = training.policy()
    at = feature_slices(policy.layout)["goal_direction"]
    seen = training._observation.numpy()
    np.testing.assert_allclose(policy(seen), seen[:, at], atol=0.2)
    assert np.corrcoef(policy(seen).ravel(), seen[:, at].ravel())[0, 1] > 0.99
    weights = []
    for _ in range(2):
        training = DevicePpo(GOALS)
        training.iterate(1.0)
        weights.append(training.policy())
    assert all(np.array_equal(a, b) for a, b in zip(weights[0].weights, weights[1].weights, strict=True))
    assert not np.array_equal(weights[0].value_weights[0], policy.value_weights[0])
    agent = load_policy(weights[0].save(tmp_path / "p"))
    assert len(evaluate(agent, "test", 2, bank="mini", progress=False).records) == 2


def test_goals_on_the_device_are_those_of_the_agent():
    training = DevicePpo(GOALS)
    env, choices = training.env, training._choices
    bank = env.simulation.bank
    rows = env.target_rows.numpy()
    seen = training._observation.numpy()
    at = feature_slices(choices.layout)
    for i in range(4):
        scene, target = bank.scenes[bank.arrays.scene[rows[i]]], int(bank.arrays.tomato[rows[i]])
        found = goal_options(compile_scene(scene), target, env.simulation.robot.start)
        goal = seen[i, at["goal_offset"]] + seen[i, at["joint_position"]] + seen[i, at["command_error"]]
        nearest = np.abs(found.configurations - goal).max(axis=1)
        assert nearest.min() < 1e-5
        np.testing.assert_allclose(seen[i, at["goal_clearance"]], found.clearance[nearest.argmin()], atol=1e-6)
    held = choices._goal.clone()
    training.iterate(1.0)
    changed = (choices._goal != held).any(1).numpy()
    assert 0 < changed.sum() < len(changed), "a goal changes with the episode, and not before"


@pytest.mark.parametrize("wrong", [{"action": "tip_velocity"}, {"device": "cuda"}, {"goals": -1}, {"hidden": (32, 11)}])
def test_goals_need_joint_actions_a_cpu_and_wide_layers(wrong):
    with pytest.raises(InvalidValueError, match="goals"):
        DevicePpo(replace(GOALS, **wrong))
