from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.depth_agent import DepthAgent
from greenhouse_gym.agents.judging import FEATURES, Judge
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.learning import depth
from greenhouse_gym.learning.depth import DepthSettings, Labels, fit, train_depth
from greenhouse_gym.learning.training_files import read_curve
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank

WIDTH = sum(size for _, size in FEATURES)


def some_labels(count: int) -> Labels:
    features = np.random.default_rng(0).normal(size=(count, WIDTH)).astype(np.float32)
    return Labels(features, (features[:, 0] + features[:, 3] > 0.5).astype(np.float32))


def test_the_network_learns_what_the_teacher_says() -> None:
    labels = some_labels(600)
    network, error = fit(labels, DepthSettings(hidden=(16,), updates=120, batch_size=64, learning_rate=1e-2))
    share = labels.free.mean()
    assert error < 0.5 * 4 * share * (1 - share), "a constant would do half as well"
    right = (Judge(network)(labels.features) > 0.5) == labels.free
    assert right.mean() > 0.9


def test_its_file_says_what_torch_says() -> None:
    network, _ = fit(some_labels(200), DepthSettings(hidden=(16, 8), updates=20, batch_size=32))
    x = torch.as_tensor((some_labels(50).features - network.center) / network.scale)
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        x = torch.relu(torch.nn.functional.linear(x, torch.as_tensor(weight), torch.as_tensor(bias)))
    last = torch.nn.functional.linear(x, torch.as_tensor(network.weights[-1]), torch.as_tensor(network.biases[-1]))
    np.testing.assert_allclose(network(some_labels(50).features), last.clip(-1, 1).numpy(), atol=1e-5)


def test_labels_are_read_as_they_were_written(tmp_path: Path) -> None:
    labels = some_labels(40)
    turned = Labels(np.asfortranarray(labels.features), labels.free)
    depth.write_labels(tmp_path / "round-0.safetensors", turned, {"success": 0.5})
    read, row = depth.read_labels(tmp_path / "round-0.safetensors")
    np.testing.assert_array_equal(read.features, labels.features)
    np.testing.assert_array_equal(read.free, labels.free)
    assert row == {"success": 0.5}


def test_a_training_is_resumed_and_its_network_plays(bank: SceneBank, scene: Scene, tmp_path: Path) -> None:
    settings = DepthSettings(
        bank=str(bank.path), rounds=1, episodes=1, hidden=(8,), updates=10, batch_size=32, validation_episodes=1
    )
    train_depth(settings, tmp_path / "short")
    with pytest.raises(InvalidValueError, match="would be lost"):
        train_depth(settings, tmp_path / "short")
    with pytest.raises(InvalidValueError, match="other settings: margin"):
        train_depth(replace(settings, margin=0.01), tmp_path / "short", resume=True)
    with pytest.raises(InvalidValueError, match="nothing to resume"):
        train_depth(settings, tmp_path / "nowhere", resume=True)
    told: list[int] = []
    longer = replace(settings, rounds=2)
    path = train_depth(longer, tmp_path / "short", resume=True, tell=lambda done, figures: told.append(done))
    assert told == [2]
    rows = read_curve(tmp_path / "short" / "curve.csv")
    assert [row["validation_success"] for row in rows] in ([0, 0], [0, 1], [1, 0], [1, 1])
    drawn = EventAccumulator(str(tmp_path / "short" / "tensorboard")).Reload()
    assert [event.step for event in drawn.Scalars("depth/validation_success")] == [1, 2]
    agent = make_agent(str(path))
    assert isinstance(agent, DepthAgent)
    iiwa = get_robot("iiwa14")
    with pytest.raises(InvalidValueError, match="drives 'ur5e'"):
        agent.reset(Problem(scene, 0, iiwa, iiwa.start))

    labels = tmp_path / "short" / "round-0.safetensors"
    labels.write_bytes(labels.read_bytes()[:-8])
    with pytest.raises(FileFormatError, match="round-0"):
        train_depth(longer, tmp_path / "short", resume=True)
