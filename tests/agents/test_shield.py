from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from gymnasium import spaces

from greenhouse_gym.agents import Agent, PlannerAgent, Problem, RandomAgent, ShieldedAgent, StraightLineAgent
from greenhouse_gym.envs import GreenhouseEnv
from greenhouse_gym.envs.actions import ToolMotion
from greenhouse_gym.envs.state import State
from greenhouse_gym.evaluation import AgentError, evaluate
from greenhouse_gym.geometry import Array
from greenhouse_gym.scene import SceneBank


class Forward(RandomAgent):
    """Leans into the plants at full speed."""

    name = "forward"

    def act(self, observation: object) -> npt.NDArray[np.float32]:
        return np.array([0, 1, 1, 0, 0, 0], dtype=np.float32)


@pytest.mark.parametrize("agent", [Forward(), StraightLineAgent()], ids=lambda agent: agent.name)
def test_hardly_anything_is_touched_whatever_the_agent_wants(bank: SceneBank, agent: Agent) -> None:
    options: dict[str, Any] = {"episodes": 6, "seed": 3, "bank": bank, "start": "upright"}
    assert evaluate(agent, **options).collision_rate >= 0.5
    assert evaluate(ShieldedAgent(agent), **options).collision_rate < 0.2


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


class ToTheRow(RandomAgent):
    """Moves its tip into the plants at full speed."""

    name = "to the row"

    def act(self, observation: object) -> npt.NDArray[np.float32]:
        return np.array([1, 0, 0, 0, 0, 0], dtype=np.float32)


def test_actions_of_the_tip_are_shielded(bank: SceneBank) -> None:
    options: dict[str, Any] = {"episodes": 6, "seed": 3, "bank": bank, "action": "tip_velocity"}
    assert evaluate(ToTheRow(), **options).collision_rate >= 0.5
    assert evaluate(ShieldedAgent(ToTheRow()), **options).collision_rate < 0.2


def test_the_command_after_an_action_of_the_tip_is_foreseen(bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank, action="tip_velocity")
    observation, _ = env.reset(seed=1)
    shield, simulation = ShieldedAgent(ToTheRow()), env.simulation
    shield.reset(Problem(env.scene, env.target, env.robot, env.start, 0, simulation.action_rule, simulation.interval))
    env.step(shield.act(observation))
    np.testing.assert_allclose(shield._command, simulation.command[0], atol=1e-9)


def test_own_actions_are_refused(bank: SceneBank) -> None:
    class Other:
        space = spaces.Box(-1, 1, (6,), dtype=np.float32)

        def __call__(self, action: Array, state: State, motion: ToolMotion) -> Array:
            return np.zeros((len(action), 6))

    with pytest.raises(AgentError, match="the package's own only"):
        evaluate(ShieldedAgent(RandomAgent()), episodes=1, bank=bank, action=Other())
    assert isinstance(ShieldedAgent(RandomAgent()), Agent)
