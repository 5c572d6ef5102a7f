from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("safetensors")

from greenhouse_gym.agents.agent import Agent, Problem
from greenhouse_gym.agents.policy_agent import Policy, PolicyAgent
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene


@pytest.fixture
def policy() -> Policy:
    random = np.random.default_rng(0)
    sizes = [4, 5, 2]
    return Policy(
        weights=tuple(random.normal(size=(b, a)).astype(np.float32) for a, b in pairwise(sizes)),
        biases=tuple(random.normal(size=b).astype(np.float32) for b in sizes[1:]),
        activation="tanh",
        center=np.array([0.1, 0, 0, 0], dtype=np.float32),
        scale=np.array([2, 1, 1, 1], dtype=np.float32),
        env_options={"robot": "ur5e"},
        layout=(("a", 1), ("b", 3)),
        training={"steps": 3},
    )


def test_forward_pass(policy: Policy) -> None:
    x = np.array([0.3, -0.1, 0.2, 0.0])
    hidden = np.tanh(policy.weights[0] @ ((x - policy.center) / policy.scale) + policy.biases[0])
    expected = np.clip(policy.weights[1] @ hidden + policy.biases[1], -1, 1)
    np.testing.assert_allclose(policy(x), expected, atol=1e-6)
    np.testing.assert_allclose(policy(np.stack([x, x])), [expected, expected], atol=1e-6)
    with pytest.raises(InvalidValueError, match="4 entries"):
        policy(np.zeros((2, 3)))


@pytest.mark.parametrize("suffix", ["", ".json", ".safetensors"])
def test_saved_and_loaded_policies_are_equal(policy: Policy, tmp_path: Path, suffix: str) -> None:
    policy.save(tmp_path / "p-0.5")
    loaded = Policy.load(tmp_path / f"p-0.5{suffix}")
    for a, b in zip((*policy.weights, *policy.biases), (*loaded.weights, *loaded.biases), strict=True):
        np.testing.assert_array_equal(a, b)
    assert (loaded.activation, loaded.layout, loaded.training) == ("tanh", policy.layout, {"steps": 3})
    agent = PolicyAgent.load(tmp_path / "p-0.5.json")
    assert isinstance(agent, Agent)
    assert agent.name == "p-0.5"


def test_damaged_files_are_named(policy: Policy, tmp_path: Path) -> None:
    path = policy.save(tmp_path / "p")
    with pytest.raises(UnknownNameError, match="policy"):
        PolicyAgent.load(tmp_path / "q")
    content = json.loads(path.read_text())
    damages = {
        "network": {**content, "network": {"kind": "mlp", "sizes": [4, 6, 2], "activation": "tanh"}},
        "version": {**content, "schema_version": 9},
        "lacks": {k: v for k, v in content.items() if k != "env_options"},
    }
    for message, damaged in damages.items():
        path.write_text(json.dumps(damaged))
        with pytest.raises(FileFormatError, match=message):
            PolicyAgent.load(path)
    path.write_text("{")
    with pytest.raises(FileFormatError, match="JSON"):
        PolicyAgent.load(path)
    path.write_text(json.dumps(content))
    (tmp_path / "p.safetensors").write_bytes(b"12345678")
    with pytest.raises(FileFormatError, match="safetensors"):
        PolicyAgent.load(path)
    (tmp_path / "p.safetensors").unlink()
    with pytest.raises(FileFormatError, match="cannot be read"):
        PolicyAgent.load(path)


def test_another_arm_is_refused(policy: Policy, scene: Scene) -> None:
    robot = get_robot("ur5e")
    PolicyAgent(policy).reset(Problem(scene, 0, robot, robot.start))
    foreign = Policy(**{**vars(policy), "env_options": {"robot": "iiwa14"}})
    with pytest.raises(InvalidValueError, match="iiwa14"):
        PolicyAgent(foreign).reset(Problem(scene, 0, robot, robot.start))
