from __future__ import annotations

from typing import Any

from still_agent import StillAgent

from greenhouse_gym.agents import HybridAgent, PlannerAgent, Problem
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.scene import SceneBank

PROBLEMS = [("made-up-0", k) for k in (0, 4, 7)]


class Listening(PlannerAgent):
    """Counts its episodes."""

    episodes = 0

    def reset(self, problem: Problem) -> None:
        self.episodes += 1
        super().reset(problem)


def test_it_plans_where_the_policy_would_fail(bank: SceneBank) -> None:
    planner = Listening()
    records = evaluate(HybridAgent(StillAgent(), planner), bank=bank, problems=PROBLEMS).records
    assert [(r.success, r.status) for r in records] == [(True, "solved")] * 3
    assert planner.episodes == 3


def test_it_does_not_plan_where_the_policy_succeeds(bank: SceneBank) -> None:
    """A planner stands in for a policy that succeeds; what it does is what it did in the rehearsal."""
    policy, planner = Listening(), Listening()
    hybrid = evaluate(HybridAgent(policy, planner, name="both"), bank=bank, problems=PROBLEMS, num_envs=1)
    alone = evaluate(PlannerAgent(), bank=bank, problems=PROBLEMS)
    assert hybrid.agent == "both"
    assert [(r.success, r.status) for r in hybrid.records] == [(True, "rehearsed")] * 3
    assert (policy.episodes, planner.episodes) == (6, 0)
    assert [r.joint_length for r in hybrid.records] == [r.joint_length for r in alone.records]


def test_what_the_agents_need_is_needed_by_both() -> None:
    class Needy(StillAgent):
        env_options: Any = {"observation": "goal"}  # noqa: RUF012

    assert HybridAgent(Needy()).env_options == {"observation": "goal", "action": "joint"}
    assert HybridAgent().env_options["robot"] == "ur5e"
