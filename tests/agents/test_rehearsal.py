from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("safetensors")

from test_goal_choice import with_weights

from greenhouse_gym.agents import GoalChoosingAgent, Problem, ShieldedAgent, make_agent
from greenhouse_gym.agents.agent import Agent
from greenhouse_gym.agents.goal_choice import MAX_STALL
from greenhouse_gym.agents.rehearsal import rehearse
from greenhouse_gym.agents.watchful import WatchfulAgent
from greenhouse_gym.envs import make_env
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.geometry import Box
from greenhouse_gym.motion.goal_options import MAX_OPTIONS, goal_options
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank, compile_scene

ROBOT = get_robot("ur5e")


def played(agent: Agent, bank: SceneBank, seed: int) -> tuple[Problem, list[np.ndarray], bool]:
    """Return an episode's problem, the commands after each action, and whether the target was reached."""
    env = make_env(bank=bank, split="train", difficulty="easy", **agent.env_options)
    observation, _ = env.reset(seed=seed)
    problem = Problem.of(env.simulation, 0, seed)
    agent.reset(problem)
    commands, over = [], False
    while not over:
        observation, _, terminated, truncated, info = env.step(agent.act(observation))
        commands.append(observation[:6] + observation[12:18])
        over = terminated or truncated
    env.close()
    return problem, commands, bool(info["is_success"])


@pytest.mark.parametrize("shielded", [False, True])
def test_the_arm_then_moves_as_it_was_rehearsed(bank: SceneBank, shielded: bool) -> None:
    agent: Agent = GoalChoosingAgent(with_weights([0, 1, 0, 0, 0, 0]))
    agent = ShieldedAgent(agent) if shielded else agent
    outcomes = []
    for seed in range(8):
        problem, commands, success = played(agent, bank, seed)
        rehearsed = rehearse(agent, problem)
        outcomes.append((success, rehearsed is not None))
        if rehearsed is not None:
            np.testing.assert_allclose(rehearsed, commands, atol=1e-5)
    assert (True, True) in outcomes
    assert (False, True) not in outcomes, "what is rehearsed succeeds"


def test_a_motion_that_touches_something_or_takes_too_long_is_no_path(bank: SceneBank) -> None:
    agent = GoalChoosingAgent(with_weights([0, 1, 0, 0, 0, 0]))
    problem = next(p for p, _, success in (played(agent, bank, seed) for seed in range(8)) if success)
    path = rehearse(agent, problem)
    assert path is not None
    assert rehearse(agent, replace(problem, step_limit=len(path) + 1)) is not None
    assert rehearse(agent, replace(problem, step_limit=len(path) - 1)) is None
    wall = Box(problem.scene.tomatoes[problem.target].center - [0.15, 0, 0], [0.002, 1.0, 1.0], np.eye(3))
    blocked = problem.scene.model_copy(update={"clutter": (*problem.scene.clutter, wall)})
    assert rehearse(agent, replace(problem, scene=blocked)) is None


def test_the_agent_that_looks_rehearses_a_policy(bank: SceneBank, tmp_path: Path) -> None:
    path = with_weights([0, -1, 0, 0, 0, 0]).save(tmp_path / "straight")
    agent = WatchfulAgent(policy=path)
    assert agent.name == "watchful-straight"
    assert agent.env_options["robot"] == "ur5e"
    assert not agent.takes_other_actions, "the policy has joint actions"
    figures = evaluate(agent, "train", 6, bank=bank, progress=False, difficulty="easy")
    assert [record.collision for record in figures.records] == [False] * 6
    assert sum(record.success for record in figures.records) >= 4
    assert all(record.status.endswith((", inf", "no path")) for record in figures.records)


def test_the_agent_that_looks_takes_shipped_policies_by_name() -> None:
    assert make_agent("watchful-ppo-goals-ur5e").name == "watchful-ppo-goals-ur5e"
    with pytest.raises(InvalidValueError, match=r"observation='state' and action='joint' can be rehearsed, ppo-warp"):
        make_agent("watchful-ppo-warp-ur5e")
    for missing in ("watchful-ppo", "watchful-"):
        with pytest.raises(UnknownNameError, match="watchful-POLICY"):
            make_agent(missing)


def test_an_arm_that_is_held_up_tries_each_goal(scene: Scene) -> None:
    agent = GoalChoosingAgent(with_weights([0, 1, 0, 0, 0, 0]))
    problem = Problem(scene, 4, ROBOT, ROBOT.start)
    agent.reset(problem)
    held = np.zeros(len(agent.policy.center) - 21, dtype=np.float32)
    held[:6] = problem.start
    chosen = []
    for _ in range((MAX_STALL + 2) * MAX_OPTIONS):
        agent.act(held)
        chosen.append(tuple(agent.network_input(held)[0, -21:-15]))
    found = len(goal_options(compile_scene(scene, ROBOT), 4, ROBOT.start).configurations)
    assert len(set(chosen)) == found > 3
    values = [goal[1] for goal in dict.fromkeys(chosen)]
    assert values == sorted(values, reverse=True), "those of the highest value first"
    assert chosen[0] == chosen[MAX_STALL + 1] != chosen[MAX_STALL + 2]
