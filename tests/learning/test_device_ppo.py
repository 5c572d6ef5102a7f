from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("warp")
pytest.importorskip("torch")

from greenhouse_gym.agents.policy_agent import PolicyAgent
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.learning import DevicePpoSettings, train_ppo_on_device
from greenhouse_gym.learning.device_ppo import DevicePpo
from greenhouse_gym.learning.training_files import CURVE, read_curve
from greenhouse_gym.scene import SceneBank

SMALL = DevicePpoSettings(
    bank="mini", num_envs=32, rollout_steps=16, minibatches=4, epochs=2, total_steps=2048, hidden=(32, 32)
)


def test_policy_plays_in_mujoco(tmp_path):
    lines = []
    path = train_ppo_on_device(SMALL, tmp_path / "run", on_progress=lines.append)
    assert lines[-1]["steps"] == 2048
    assert read_curve(tmp_path / "run" / CURVE)[-1]["steps"] == 2048
    agent = PolicyAgent.load(path)
    assert agent.policy.training["steps"] == 2048
    result = evaluate(agent, "test", 2, bank="mini", progress=False)
    assert len(result.records) == 2
    with pytest.raises(InvalidValueError, match="another folder"):
        train_ppo_on_device(SMALL, tmp_path / "run")


def test_same_seed_same_policy():
    weights = []
    for _ in range(2):
        training = DevicePpo(SMALL)
        training.iterate(1.0)
        weights.append(training.policy().weights)
    assert all(np.array_equal(a, b) for a, b in zip(*weights, strict=True))


def test_interrupted_training_leaves_a_policy(tmp_path):
    def stop(line):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_ppo_on_device(SMALL, tmp_path / "run", on_progress=stop)
    assert PolicyAgent.load(tmp_path / "run" / "policy").policy.training["algorithm"] == "PPO on a device"


def test_sizes_follow_the_device_and_sources_choose_the_rows():
    assert (DevicePpoSettings().num_envs, DevicePpoSettings().rollout_steps) == (512, 32)
    assert (DevicePpoSettings(device="cuda").num_envs, DevicePpoSettings(device="cuda").rollout_steps) == (4096, 24)
    assert DevicePpoSettings(num_envs=32).num_envs == 32
    training = DevicePpo(replace(SMALL, sources=("own",), action="tip_velocity"))
    bank = training.env.simulation.sampler.bank
    assert {entry.source for entry in bank.manifest.scenes} == {"own"}
    assert training.policy().training["bank_sha256"] == SceneBank.open("mini").sha256
