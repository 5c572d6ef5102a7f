from __future__ import annotations

import csv
import json
import zipfile
from pathlib import Path

import gymnasium
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3 import PPO

from greenhouse_gym.agents.policy_agent import PolicyAgent
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.integrations.sb3 import make_sb3_vec_env
from greenhouse_gym.learning.checkpoints import NAME, load_checkpoint, save_checkpoint
from greenhouse_gym.learning.policies import save_policy, score
from greenhouse_gym.learning.ppo import PpoSettings, _model, train_ppo
from greenhouse_gym.scene import SceneBank


@pytest.fixture
def settings(bank: SceneBank) -> PpoSettings:
    return PpoSettings(
        bank=str(bank.path), total_steps=128, num_envs=4, rollout_steps=8, batch_size=16, epochs=2, hidden=(16, 16)
    )


def test_plain_ppo_takes_the_environment(bank: SceneBank) -> None:
    model = PPO("MlpPolicy", gymnasium.make("TomatoReach-v0", bank=bank), n_steps=32, batch_size=32, device="cpu")
    model.learn(64)
    assert model.num_timesteps == 64


def test_training_leaves_curve_checkpoint_and_policy(settings: PpoSettings, tmp_path: Path) -> None:
    path = train_ppo(settings, tmp_path)
    files = {p.name for p in tmp_path.iterdir()}
    assert files == {"settings.json", "curve.csv", NAME, "policy.json", "policy.safetensors"}
    assert not any(zipfile.is_zipfile(p) for p in tmp_path.iterdir())
    rows = list(csv.DictReader((tmp_path / "curve.csv").read_text().splitlines()))
    assert [int(row["steps"]) for row in rows] == [32, 64, 96, 128]
    description = json.loads(path.read_text())
    assert description["training"]["steps"] == 128
    assert description["env_options"] == {"robot": "ur5e", "observation": "state", "action": "joint"}
    agent = PolicyAgent.load(path)
    assert agent.act(np.zeros(60)).shape == (6,)


def test_resuming_goes_on_where_the_checkpoint_was(settings: PpoSettings, tmp_path: Path) -> None:
    train_ppo(settings, tmp_path)
    longer = PpoSettings(**{**vars(settings), "total_steps": 192})
    path = train_ppo(longer, tmp_path, resume=True)
    rows = list(csv.DictReader((tmp_path / "curve.csv").read_text().splitlines()))
    assert [int(float(row["steps"])) for row in rows] == [32, 64, 96, 128, 160, 192]
    assert json.loads(path.read_text())["training"]["steps"] == 192
    other = PpoSettings(**{**vars(settings), "hidden": (8, 8)})
    with pytest.raises(InvalidValueError, match="hidden"):
        train_ppo(other, tmp_path, resume=True)


def test_an_interrupted_training_keeps_what_it_has(settings: PpoSettings, tmp_path: Path) -> None:
    train_ppo(PpoSettings(**{**vars(settings), "total_steps": 10**9}), tmp_path, time_limit=0.5)
    assert {NAME, "policy.json"} <= {p.name for p in tmp_path.iterdir()}


def test_checkpoints_restore_weights_and_optimizer(settings: PpoSettings, tmp_path: Path) -> None:
    env = make_sb3_vec_env(4, bank=settings.bank, seed=0)
    model, fresh = _model(settings, env), _model(PpoSettings(**{**vars(settings), "seed": 9}), env)
    model.learn(64)
    save_checkpoint(model, tmp_path, {"settings": {}})
    load_checkpoint(fresh, tmp_path)
    assert fresh.num_timesteps == 64
    for a, b in zip(model.policy.parameters(), fresh.policy.parameters(), strict=True):
        assert torch.equal(a, b)
    mine, theirs = model.policy.optimizer.state_dict()["state"], fresh.policy.optimizer.state_dict()["state"]
    assert mine.keys() == theirs.keys()
    for i in mine:
        assert all(torch.equal(torch.as_tensor(mine[i][k]), torch.as_tensor(theirs[i][k])) for k in mine[i])
    (tmp_path / NAME).write_bytes(b"nonsense")
    with pytest.raises(FileFormatError, match=NAME):
        load_checkpoint(fresh, tmp_path)


def test_the_saved_policy_acts_as_the_model(settings: PpoSettings, bank: SceneBank, tmp_path: Path) -> None:
    env = make_sb3_vec_env(4, bank=bank, seed=0)
    model = _model(settings, env)
    model.learn(32)
    agent = PolicyAgent.load(save_policy(model, tmp_path / "mine"))
    assert agent.name == "mine"
    observations = env.reset()
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose(agent.act(observations), expected, atol=1e-5)
    np.testing.assert_allclose(agent.act(observations[0]), expected[0], atol=1e-5)


def test_score_counts_endings(bank: SceneBank) -> None:
    still = score(lambda observations: np.zeros((len(observations), 6)), 6, bank=bank)
    assert still == (6, 0.0, 0.0, 200.0)
    falling = score(lambda observations: np.tile([0, 1.0, 0, 0, 0, 0], (len(observations), 1)), 16, bank=bank)
    assert falling.collision > 0.2
    assert falling.steps < 200
