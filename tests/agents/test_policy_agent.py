from __future__ import annotations

import hashlib
import json
import random
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("safetensors")

from greenhouse_gym.agents.agent import Agent, Problem
from greenhouse_gym.agents.goal_choice import load_policy
from greenhouse_gym.agents.goal_features import flaw_of
from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.agents.policy_agent import BEST, PolicyAgent, shipped_policies
from greenhouse_gym.envs import EnvSettings
from greenhouse_gym.errors import FileFormatError, GreenhouseError, InvalidValueError, UnknownNameError
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
    many = np.random.default_rng(1).normal(size=(37, 4))
    assert np.array_equal(policy(many), [policy(one) for one in many]), "company changes the action"
    with pytest.raises(InvalidValueError, match="4 entries"):
        policy(np.zeros((2, 3)))
    squashed = Policy(**{**vars(policy), "output": "tanh"})
    np.testing.assert_allclose(squashed(x), np.tanh(policy.weights[1] @ hidden + policy.biases[1]), atol=1e-6)


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


def test_weights_take_half_the_space_where_nothing_is_lost(policy: Policy, tmp_path: Path) -> None:
    from safetensors.numpy import load_file

    rounded, exact = np.float32(np.float16(policy.weights[0])), policy.weights[1] + np.float32(1e-5)
    large = policy.biases[0] + np.float32(1e5)  # beyond half precision
    mixed = replace(policy, weights=(rounded, exact, *policy.weights[2:]), biases=(large, *policy.biases[1:]))
    path = mixed.save(tmp_path / "p")
    stored = load_file(path.with_suffix(".safetensors"))
    assert stored["layer_0.weight"].dtype == np.float16
    assert stored["layer_1.weight"].dtype == stored["layer_0.bias"].dtype == np.float32
    loaded = Policy.load(path)
    for a, b in zip((*mixed.weights, *mixed.biases), (*loaded.weights, *loaded.biases), strict=True):
        assert b.dtype == np.float32
        np.testing.assert_array_equal(a, b)


def test_a_file_states_the_action_and_without_one_it_is_of_the_joints(policy: Policy, tmp_path: Path) -> None:
    path = policy.save(tmp_path / "p")
    assert Policy.load(path).env_options == {"robot": "ur5e", "action": EnvSettings().action}
    content = json.loads(path.read_text())
    del content["env_options"]["action"]
    path.write_text(json.dumps(content))
    assert Policy.load(path).env_options == {"robot": "ur5e", "action": "joint"}


def test_damaged_files_are_named(policy: Policy, tmp_path: Path) -> None:
    path = policy.save(tmp_path / "p")
    with pytest.raises(UnknownNameError, match="policy"):
        PolicyAgent.load(tmp_path / "q")
    content = json.loads(path.read_text())
    damages = {
        r"layer_0.weight must be float32 or float16 of shape \(6, 4\)": {
            **content,
            "network": {"kind": "mlp", "sizes": [4, 6, 2], "activation": "tanh"},
        },
        "schema_version: Input should be 2": {**content, "schema_version": 9},
        r"network\.output: Input should be 'clip' or 'tanh'": {
            **content,
            "network": {**content["network"], "output": "softmax"},
        },
        "env_options: Field required": {k: v for k, v in content.items() if k != "env_options"},
        "observation_layout has 3 entries, the network takes 4": {**content, "observation_layout": [["a", 3]]},
        r"env_options\.physics": {**content, "env_options": {"physics": "moved"}},
        r"env_options\.start": {**content, "env_options": {"start": "folded"}},
    }
    for layout, message in (
        ([["goal_features", 4]], "goal_features must be the last group of the observation_layout, with 18 entries"),
        ([["goal_features", 1], ["b", 3]], "goal_features must be the last group"),
    ):
        damages[message] = {**content, "observation_layout": layout}
    for message, damaged in damages.items():
        path.write_text(json.dumps(damaged))
        with pytest.raises(FileFormatError, match=message):
            PolicyAgent.load(path)
    path.write_text("{")
    with pytest.raises(FileFormatError, match="JSON"):
        PolicyAgent.load(path)
    path.write_text(json.dumps(content))
    weights = tmp_path / "p.safetensors"
    flipped = bytearray(weights.read_bytes())
    flipped[-3] ^= 1
    weights.write_bytes(flipped)
    with pytest.raises(FileFormatError, match=r"p\.safetensors: checksum differs from the one in p\.json"):
        PolicyAgent.load(path)
    weights.write_bytes(b"12345678")
    path.write_text(json.dumps({**content, "weights_sha256": hashlib.sha256(b"12345678").hexdigest()}))
    with pytest.raises(FileFormatError, match="not a valid safetensors file"):
        PolicyAgent.load(path)
    (tmp_path / "p.safetensors").unlink()
    with pytest.raises(FileFormatError, match="cannot be read"):
        PolicyAgent.load(path)


@pytest.mark.parametrize("missing", ["tip_position", "tool_axis", "clearance"])
def test_features_of_goals_need_what_they_are_made_of(missing: str) -> None:
    whole = (("tip_position", 3), ("tool_axis", 3), ("clearance", 9), ("goal_features", 18))
    assert flaw_of(whole) == flaw_of(whole[:-1]) == ""
    assert f"needs a group '{missing}'" in flaw_of(tuple(group for group in whole if group[0] != missing))


def test_another_arm_is_refused(policy: Policy, scene: Scene) -> None:
    robot = get_robot("ur5e")
    PolicyAgent(policy).reset(Problem(scene, 0, robot, robot.start))
    foreign = Policy(**{**vars(policy), "env_options": {"robot": "iiwa14"}})
    with pytest.raises(InvalidValueError, match="iiwa14"):
        PolicyAgent(foreign).reset(Problem(scene, 0, robot, robot.start))


def test_what_a_file_cannot_hold_is_not_written(policy: Policy, tmp_path: Path) -> None:
    for changed, told in (
        ({"env_options": {"observation": object()}}, r"env_options|observation: Input should be a valid string"),
        ({"weights": tuple(w[:, :-1] for w in policy.weights)}, "has 4 entries, the network takes 3"),
        ({"biases": policy.biases[::-1]}, r"layer_0.bias must be float32 or float16 of shape \(5,\)"),
        ({"scale": np.zeros(4, dtype=np.float32)}, "scale has zeros"),
        ({"biases": (policy.biases[0] * np.nan, policy.biases[1])}, "not finite"),
        ({"training": {"by": object()}}, "not JSON"),
    ):
        with pytest.raises(InvalidValueError, match=told):
            Policy(**{**vars(policy), **changed}).save(tmp_path / "p")
    assert not list(tmp_path.iterdir())


def test_shipped_policies_load_and_say_what_they_were_trained_on() -> None:
    assert {"ppo-ur5e", "ppo-goals-ur5e", BEST} <= set(shipped_policies())
    for name in shipped_policies():
        agent = load_policy(name)
        assert agent.env_options["observation"] in ("state", "roadmap", "goal_roadmap")
        assert agent.policy.training["settings"].get("split", "train") == "train"


MUTANTS = 300
ODD = (
    None,
    True,
    -1,
    0,
    1,
    2.5,
    1 << 40,
    "",
    "tanh",
    "\0",
    [],
    [[]],
    {},
    [["a", "b"]],
    [4, 0, 2],
    [4, 5, 2],
    [1],
    "nan",
)


def test_mutants_are_loaded_or_refused_by_name(policy: Policy, scene: Scene, tmp_path: Path) -> None:
    """Changed files, with the checksum made right again: nothing but the package's own errors, also in use."""
    rng, arm = random.Random(0), get_robot("ur5e")
    path = policy.save(tmp_path / "p")
    content, weights = json.loads(path.read_text()), (tmp_path / "p.safetensors").read_bytes()
    refused = 0
    for _ in range(MUTANTS):
        changed, data = json.loads(json.dumps(content)), bytearray(weights)
        kind = rng.randrange(4)
        if kind == 0:
            header = 8 + int.from_bytes(data[:8], "little")
            for _ in range(rng.randint(1, 4)):
                data[rng.randrange(header)] = rng.choice(b'0123456789[],:{}"fF\xff')
        if kind == 1:
            del data[rng.randrange(len(data)) :]
        changed["weights_sha256"] = hashlib.sha256(data).hexdigest()
        if kind == 2:
            _change_something(changed, rng)
        text = bytearray(json.dumps(changed).encode())
        if kind == 3:
            i = rng.randrange(len(text))
            text[i : i + rng.randrange(3)] = rng.choice([b"[" * 100_000, b"1e999", b"\xff", b"-", b"{", b"NaN"])
        path.write_bytes(text)
        (tmp_path / "p.safetensors").write_bytes(data)
        try:
            agent = PolicyAgent.load(path)
            agent.reset(Problem(scene, 0, arm, arm.start))
            assert agent.act(np.zeros(4)).shape == (2,)
        except GreenhouseError:
            refused += 1
    assert refused > 0.5 * MUTANTS


def _change_something(content: Any, rng: random.Random) -> None:
    """Replace, remove or add a value somewhere in a JSON document."""
    while True:
        keys = list(content) if isinstance(content, dict) else list(range(len(content)))
        key = rng.choice(keys)
        deeper = isinstance(content[key], dict | list) and content[key]
        if not deeper or rng.random() < 0.4:
            break
        content = content[key]
    if rng.random() < 0.2:
        del content[key]
    else:
        content[key] = rng.choice(ODD)
