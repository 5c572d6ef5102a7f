"""Every agent under every kind of action: it works, or says which kind it needs."""

from __future__ import annotations

import numpy as np
import pytest
from still_agent import StillAgent

from greenhouse_gym.agents import Agent, HybridAgent, PlannerAgent, RandomAgent, ShieldedAgent, StraightLineAgent
from greenhouse_gym.agents.agent import action_towards, options_for
from greenhouse_gym.envs.actions import ACTIONS
from greenhouse_gym.evaluation import AgentError, compare, evaluate
from greenhouse_gym.scene import SceneBank

ROBOTS = ("ur5e", "iiwa14")


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("action", ACTIONS)
def test_simple_agents_work_with_every_action(bank: SceneBank, action: str, robot: str) -> None:
    for evaluation in compare([StillAgent(), RandomAgent()], episodes=2, bank=bank, action=action, robot=robot):
        assert len(evaluation.records) == 2
        assert evaluation.failures == 0
        assert all(r.steps > 0 for r in evaluation.records)


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("action", ["joint", "joint_velocity"])
def test_planned_paths_are_followed_with_every_joint_action(bank: SceneBank, action: str, robot: str) -> None:
    problems = [("made-up-0", k) for k in (0, 4, 7)]
    evaluation = evaluate(PlannerAgent(), bank=bank, action=action, robot=robot, problems=problems)
    solved = [r for r in evaluation.records if r.status == "solved"]
    assert len(solved) >= 2
    assert all(r.success for r in solved)


@pytest.mark.parametrize("agent", [PlannerAgent(), StraightLineAgent()], ids=lambda agent: agent.name)
def test_agents_on_joint_paths_refuse_actions_of_the_tip(bank: SceneBank, agent: Agent) -> None:
    with pytest.raises(AgentError, match="action='joint' or 'joint_velocity' only, got TipVelocity"):
        evaluate(agent, episodes=1, bank=bank, action="tip_velocity")


def test_joint_paths_are_followed_by_default(bank: SceneBank) -> None:
    assert evaluate(PlannerAgent(), bank=bank, problems=[("made-up-0", 0)]).success_rate == 1.0
    for agent in (PlannerAgent(), ShieldedAgent(PlannerAgent()), HybridAgent(StillAgent(), PlannerAgent())):
        assert options_for(agent, {})["action"] == "joint"
        assert options_for(agent, {"action": "joint_velocity"})["action"] == "joint_velocity"
    assert "action" not in options_for(StillAgent(), {})


def test_actions_keep_the_direction_to_a_waypoint() -> None:
    action = action_towards(np.array([0.4, -0.2, 0.0]), np.zeros(3), np.full(3, 0.08))
    np.testing.assert_allclose(action, [1.0, -0.5, 0.0])
    np.testing.assert_allclose(action_towards(np.array([0.04]), np.zeros(1), np.array([0.08])), [0.5])
