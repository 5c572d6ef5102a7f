from __future__ import annotations

import json
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("safetensors")
pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

import onnxruntime

from greenhouse_gym.agents import GoalChoosingAgent, Problem, load_policy
from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.agents.policy_agent import PolicyAgent, shipped_policies
from greenhouse_gym.cli import app
from greenhouse_gym.errors import (
    FileFormatError,
    FileWriteError,
    GreenhouseError,
    InvalidValueError,
    MissingDependencyError,
    UnknownNameError,
)
from greenhouse_gym.export.onnx_model import export_policy, onnx_model
from greenhouse_gym.scene import SceneBank


def small(activation: str = "relu", sizes: tuple[int, ...] = (5, 7, 4, 3)) -> Policy:
    random = np.random.default_rng(0)
    return Policy(
        weights=tuple(random.normal(size=(b, a)).astype(np.float32) for a, b in pairwise(sizes)),
        biases=tuple(random.normal(size=b).astype(np.float32) for b in sizes[1:]),
        activation=activation,
        center=random.normal(size=sizes[0]).astype(np.float32),
        scale=random.uniform(0.1, 3.0, sizes[0]).astype(np.float32),
        env_options={"robot": "ur5e", "observation": "state"},
        layout=(("a", 2), ("b", 3)),
        training={"steps": 3},
    )


def session(model: bytes | str) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def same(policy: Policy, runtime: Any, observations: np.ndarray) -> bool:
    (actions,) = runtime.run(["action"], {"observation": observations.astype(np.float32)})
    return actions.shape == (len(observations), len(policy.biases[-1])) and bool(
        np.abs(actions - policy(observations)).max() < 1e-5
    )


@pytest.mark.parametrize(
    "policy",
    [small("tanh"), small("relu"), small("tanh", (5, 3)), Policy(**{**vars(small("relu")), "output": "tanh"})],
    ids=["tanh", "relu", "plain", "squashed"],
)
def test_the_model_acts_as_the_policy_does(policy: Policy) -> None:
    runtime = session(onnx_model(policy))
    for count in (1, 64):
        assert same(policy, runtime, np.random.default_rng(count).normal(size=(count, 5)) * 3)
    other = {"tanh": "relu", "relu": "tanh"}[policy.activation]
    if len(policy.weights) > 1:
        many = np.random.default_rng(2).normal(size=(64, 5))
        assert not same(Policy(**{**vars(policy), "activation": other}), runtime, many)


def one_input(agent: PolicyAgent | GoalChoosingAgent, observation: Any) -> Any:
    """Return the input of an agent's network; that of its first goal if it has still to choose one."""
    seen = agent.network_input(observation)
    return seen[0] if isinstance(agent, GoalChoosingAgent) else seen


@pytest.mark.parametrize("name", shipped_policies())
def test_a_shipped_policy_acts_alike_in_an_episode(name: str, bank: SceneBank, tmp_path: Path) -> None:
    agent = load_policy(name)
    out = tmp_path / "deep" / "p.onnx"
    assert CliRunner().invoke(app, ["policy", "export", name, "--out", str(out)]).exit_code == 0
    runtime = session(str(out))
    rows = "mini" if "task" in agent.env_options else bank  # a harvest needs true plants
    env = gymnasium.make("TomatoReach-v0", bank=rows, **agent.env_options)
    observation, _ = env.reset(seed=1)
    agent.reset(Problem.of(env.unwrapped.simulation, 0, 1))
    seen, over = [one_input(agent, observation)], False
    while not over and len(seen) < 64:
        observation, _, terminated, truncated, _ = env.step(agent.act(observation))
        seen.append(one_input(agent, observation))
        over = terminated or truncated
    env.close()
    assert len(seen) > 5
    for count in (1, len(seen)):
        assert same(agent.policy, runtime, np.array(seen[:count]))
    assert same(agent.policy, runtime, np.random.default_rng(0).normal(size=(64, len(agent.policy.center))))


def test_the_metadata_describe_the_input(tmp_path: Path) -> None:
    policy = small()
    path = export_policy(policy, tmp_path / "p.onnx", "mine")
    runtime = session(str(path))
    metadata = runtime.get_modelmeta().custom_metadata_map
    assert (metadata["robot"], metadata["observation"]) == ("ur5e", "state")
    assert json.loads(metadata["env_options"]) == {"robot": "ur5e", "observation": "state"}
    assert json.loads(metadata["observation_layout"]) == [["a", 2], ["b", 3]]
    assert json.loads(metadata["training"]) == {"steps": 3}
    assert runtime.get_modelmeta().graph_name == "mine"
    assert [i.shape for i in (*runtime.get_inputs(), *runtime.get_outputs())] == [["n", 5], ["n", 3]]
    assert [p.name for p in tmp_path.iterdir()] == ["p.onnx"], "weights lie inside"
    assert path.read_bytes() == onnx_model(policy, "mine"), "the same file each time"


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"biases": small().biases[::-1]}, "do not fit together"),
        ({"env_options": {"observation": object()}}, "no JSON"),
        ({"training": {"loss": float("nan")}}, "no JSON"),
    ],
)
def test_what_makes_no_model_is_not_written(changed: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match=message):
        export_policy(Policy(**{**vars(small()), **changed}), tmp_path / "p.onnx")
    assert not list(tmp_path.iterdir())


def test_bad_input_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    described = small().save(tmp_path / "p")
    out = tmp_path / "p.onnx"

    def failure(name: object, out: Path) -> GreenhouseError:
        error = CliRunner().invoke(app, ["policy", "export", str(name), "--out", str(out)]).exception
        assert isinstance(error, GreenhouseError), error
        return error

    unknown = failure("no-such-policy", out)
    assert isinstance(unknown, UnknownNameError)
    assert "ppo-ur5e" in str(unknown)
    written = failure(described, described / "p.onnx")  # a file is no folder
    assert isinstance(written, FileWriteError)
    assert str(described) in str(written)
    with monkeypatch.context() as hidden:
        hidden.setitem(sys.modules, "onnx", None)
        missing = failure(described, out)
    assert isinstance(missing, MissingDependencyError)
    assert "greenhouse-gym[onnx]" in str(missing)
    weights = tmp_path / "p.safetensors"
    weights.write_bytes(weights.read_bytes()[:-4])
    damaged = failure(described, out)
    assert isinstance(damaged, FileFormatError)
    assert "p.safetensors: checksum differs" in str(damaged)
    assert not out.exists()
