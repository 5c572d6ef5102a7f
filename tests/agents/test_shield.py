from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from greenhouse_gym.agents import Agent, PlannerAgent, RandomAgent, ShieldedAgent, StraightLineAgent
from greenhouse_gym.evaluation import AgentError, evaluate
from greenhouse_gym.scene import SceneBank


class Forward(RandomAgent):
    """Leans into the plants at full speed."""

    name = "forward"

    def act(self, observation: object) -> npt.NDArray[np.float32]:
        return np.array([0, 1, 1, 0, 0, 0], dtype=np.float32)


@pytest.mark.parametrize("agent", [Forward(), StraightLineAgent()], ids=lambda agent: agent.name)
def test_hardly_anything_is_touched_whatever_the_agent_wants(bank: SceneBank, agent: Agent) -> None:
    assert evaluate(agent, episodes=6, seed=3, bank=bank).collision_rate >= 0.5
    assert evaluate(ShieldedAgent(agent), episodes=6, seed=3, bank=bank).collision_rate < 0.2


def test_free_actions_are_not_changed(bank: SceneBank) -> None:
    """A planner's commands keep the same margin that the shield keeps."""
    shield = ShieldedAgent(PlannerAgent())
    problems = [("made-up-0", k) for k in (0, 4, 7)]
    records = [evaluate(agent, bank=bank, problems=problems).records for agent in (shield, PlannerAgent())]
    assert shield.changed == 0
    assert [r.joint_length for r in records[0]] == [r.joint_length for r in records[1]]


def test_it_starts_anew_with_every_episode(bank: SceneBank) -> None:
    first, again = (evaluate(ShieldedAgent(Forward()), episodes=2, bank=bank, num_envs=n).records for n in (1, 2))
    assert [r.joint_length for r in first] == [r.joint_length for r in again]


def test_actions_of_the_tip_are_refused(bank: SceneBank) -> None:
    with pytest.raises(AgentError, match="a joint path can be followed with action='joint' or 'joint_velocity' only"):
        evaluate(ShieldedAgent(RandomAgent()), episodes=1, bank=bank, action="tip_velocity")
    assert isinstance(ShieldedAgent(RandomAgent()), Agent)
