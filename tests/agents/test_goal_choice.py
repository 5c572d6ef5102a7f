from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

pytest.importorskip("safetensors")

from greenhouse_gym.agents import GoalChoosingAgent, PolicyAgent, Problem, load_policy, make_agent
from greenhouse_gym.agents.goal_inputs import goal_layout
from greenhouse_gym.agents.policy import Policy
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.envs.choices import make_observation
from greenhouse_gym.envs.tasks import TomatoReach
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.motion.goal_options import goal_options
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank, compile_scene


def with_weights(value: list[float], **changes: Any) -> Policy:
    """Return a policy that moves straight to its goal, and values goals by one number for each joint's offset."""
    robot = get_robot("ur5e")
    observation = make_observation("state", robot, TomatoReach())
    layout = (*observation.layout, *goal_layout(6, len(robot.probes)))
    size = sum(width for _, width in layout)
    first = sum(width for _, width in observation.layout)
    actor, critic = np.zeros((6, size), dtype=np.float32), np.zeros((1, size), dtype=np.float32)
    actor[:, first + 6 : first + 12] = np.eye(6)
    critic[0, first : first + 6] = value
    about: dict[str, Any] = {
        "weights": (actor,), "biases": (np.zeros(6, dtype=np.float32),),
        "value_weights": (critic,), "value_biases": (np.ones(1, dtype=np.float32),),
        "activation": "relu", "center": np.zeros(size, dtype=np.float32), "scale": np.ones(size, dtype=np.float32),
        "env_options": {"robot": "ur5e", "observation": "state", "action": "joint"}, "layout": layout,
    }  # fmt: skip
    return Policy(**{**about, **changes})


@pytest.mark.parametrize("value", [[1, 0, 0, 0, 0, 0], [0, -1, 0, 0, 0, 0], [0, 0, 0, 0, 0.5, -1]])
def test_the_goal_of_the_highest_value_is_chosen_once(bank: SceneBank, value: list[float]) -> None:
    agent = GoalChoosingAgent(with_weights(value))
    env = gymnasium.make("TomatoReach-v0", bank=bank, **agent.env_options)
    observation, _ = env.reset(seed=3)
    problem = Problem.of(env.unwrapped.simulation, 0, 1)  # type: ignore[attr-defined]
    agent.reset(problem)
    goals, clearance = goal_options(compile_scene(problem.scene, problem.robot), problem.target, problem.start)
    inputs = agent.network_input(observation)
    assert inputs.shape == (len(goals), len(agent.policy.center))
    np.testing.assert_allclose(inputs[:, -21:-15], goals - problem.start, atol=1e-6)
    np.testing.assert_allclose(inputs[:, -9:], clearance, atol=1e-6)
    best = ((goals - problem.start) @ value).argmax()
    over = False
    while not over:
        joints = observation[:6] + observation[12:18]
        offset = goals[best] - joints
        np.testing.assert_allclose(agent.act(observation), offset / max(0.08, np.abs(offset).max()), atol=1e-5)
        assert agent.network_input(observation).shape[0] == 1, "the others are forgotten"
        observation, _, terminated, truncated, _ = env.step(agent.act(observation))
        over = terminated or truncated
    env.close()


def test_each_of_several_episodes_has_its_own_goal(bank: SceneBank) -> None:
    agent = GoalChoosingAgent(with_weights([0, 1, 0, 0, 0, 0]))
    alone, together = (
        evaluate(agent, "train", 6, bank=bank, num_envs=count, progress=False, difficulty="easy") for count in (1, 3)
    )
    ends = [[(r.scene, r.target, r.steps, r.success, r.collision) for r in e.records] for e in (alone, together)]
    assert ends[0] == ends[1]
    assert len({steps for _, _, steps, _, _ in ends[0]}) > 1


def test_without_a_free_goal_the_arm_stays_at_its_start(scene: Scene) -> None:
    far = scene.model_copy(update={"tomatoes": (Tomato(Sphere([3.0, 0.0, 1.0], 0.03), truss=0),)})
    robot = get_robot("ur5e")
    agent = GoalChoosingAgent(with_weights([1, 0, 0, 0, 0, 0]))
    agent.reset(Problem(far, 0, robot, robot.start))
    seen = np.zeros(len(agent.policy.center) - 21)
    seen[:6] = robot.start
    assert not agent.act(seen).any()


def test_files_keep_the_critic(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    straight = with_weights([0] * 6)
    sizes = [len(straight.center), 8, 1]
    critic = tuple(rng.normal(size=(b, a)).astype(np.float32) for a, b in pairwise(sizes))
    biases = tuple(rng.normal(size=b).astype(np.float32) for b in sizes[1:])
    policy = replace(straight, value_weights=critic, value_biases=biases)
    many = rng.normal(size=(9, sizes[0])).astype(np.float32)
    hidden = np.maximum(many @ critic[0].T + biases[0], 0)
    np.testing.assert_allclose(policy.value(many), (hidden @ critic[1].T + biases[1])[:, 0], rtol=1e-4, atol=1e-4)
    path = policy.save(tmp_path / "p")
    agent = load_policy(path)
    assert isinstance(agent, GoalChoosingAgent)
    assert isinstance(make_agent(str(path)), GoalChoosingAgent)
    assert np.array_equal(agent.policy.value(many), policy.value(many))
    text = path.read_text()
    for wrong in ("8,\n  2", "9,\n  1"):
        path.write_text(text.replace("8,\n  1", wrong))
        with pytest.raises(FileFormatError, match="value_"):
            load_policy(path)


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"value_weights": (), "value_biases": ()}, "no critic"),
        ({"layout": (("all", 93),)}, "no goal configuration"),
        ({"layout": (("joint_position", 72), *goal_layout(6, 9))}, "end in"),
        ({"layout": (*goal_layout(6, 9), ("rest", 72))}, "end in"),
        ({"layout": (("joint_position", 6), ("clearance", 9), ("rest", 57), *goal_layout(6, 9))}, "command_error"),
    ],
    ids=["no critic", "no goal", "joints differ", "not at the end", "no command error"],
)  # fmt: skip
def test_files_whose_parts_do_not_fit_are_refused(tmp_path: Path, changed: dict[str, Any], why: str) -> None:
    policy = replace(with_weights([0] * 6), **changed)
    with pytest.raises(InvalidValueError, match=why):
        policy.save(tmp_path / "p")
    assert not list(tmp_path.iterdir())
    if "layout" in changed:  # as if written by other code
        path = with_weights([0] * 6).save(tmp_path / "p")
        content = json.loads(path.read_text())
        path.write_text(json.dumps(content | {"observation_layout": policy.layout}))
        with pytest.raises(FileFormatError, match=why):
            load_policy(path)


def test_policies_of_the_other_kind_are_refused() -> None:
    policy = with_weights([0] * 6)
    with pytest.raises(InvalidValueError, match="load_policy"):
        PolicyAgent(policy)
    plain = replace(policy, value_weights=(), value_biases=())
    with pytest.raises(InvalidValueError, match="no critic"):
        GoalChoosingAgent(plain)
    with pytest.raises(InvalidValueError, match="observes no goal"):
        GoalChoosingAgent(load_policy("ppo-ur5e").policy)
    with pytest.raises(InvalidValueError, match="no critic"):
        plain.value(np.zeros((1, len(plain.center))))
    agent, other = GoalChoosingAgent(policy), get_robot("iiwa14")
    with pytest.raises(InvalidValueError, match="drives 'ur5e'"):
        agent.reset(Problem(Scene.model_construct(), 0, other, other.start))
