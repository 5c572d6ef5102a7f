from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("ompl")

from greenhouse_gym.agents import GuidedAgent, ResolvedRateAgent
from greenhouse_gym.agents.guide import Guide, towards
from greenhouse_gym.envs import GreenhouseVectorEnv
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.planning import CollisionChecker, planning_model
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank, compile_scene


def test_it_reaches_and_touches_nothing(bank: SceneBank) -> None:
    result = evaluate(GuidedAgent(), "train", 12, bank=bank)
    assert result.success_rate >= 0.9
    assert result.collision_rate == 0.0


def test_the_way_is_free_and_always_the_same(scene: Scene) -> None:
    arm = get_robot("ur5e")
    compiled = compile_scene(scene, arm)
    guides = [Guide(compiled, 4, arm.start) for _ in range(2)]
    checker = CollisionChecker(planning_model(compiled, 4, margin=0.0))
    random = np.random.default_rng(0)
    known = 0
    for _ in range(20):
        joints = arm.start + random.normal(scale=0.3, size=6)
        first, again = (guide.waypoint(joints) for guide in guides)
        if first is None:
            assert again is None
            continue
        known += 1
        np.testing.assert_array_equal(first, again)
        assert checker.motion_is_free(joints, first, 0.01)
    assert known > 10


def test_steps_keep_their_direction() -> None:
    action = towards(np.array([0.4, -0.2, 0.0]), np.zeros(3), np.full(3, 0.08))
    np.testing.assert_allclose(action, [1.0, -0.5, 0.0])
    np.testing.assert_allclose(towards(np.array([0.04]), np.zeros(1), np.array([0.08])), [0.5])


@pytest.fixture
def lonely(scene: Scene) -> Scene:
    """A tomato on the arm's own height, and nothing else."""
    alone = scene.model_copy(update={"tomatoes": scene.tomatoes[4:5], "stems": (), "clutter": (), "targets": ()})
    return alone.model_copy(update={"name": "lonely"})


def test_resolved_rates_lead_through_free_space_and_away_from_things(lonely: Scene, scene: Scene) -> None:
    env = GreenhouseVectorEnv(2, bank="mini", threads=1)
    agents = [ResolvedRateAgent(), ResolvedRateAgent()]
    env.close()
    from greenhouse_gym.agents import Problem

    problem = Problem(lonely, 0, get_robot("ur5e"), get_robot("ur5e").start)
    for agent in agents:
        agent.reset(problem)
    observation = np.zeros(60)
    observation[:6] = problem.start
    observation[18:21] = [0.3, 0.0, 0.0]  # the target is ahead
    observation[24:33] = 0.3
    free = agents[0].act(observation)
    assert np.abs(free).max() > 0.05
    observation[18:21] = 0.0  # it is there, but something is behind the cup
    observation[32], observation[57:60] = 0.0, [-1.0, 0.0, 0.0]
    pushed = agents[1].act(observation)
    assert float(free @ pushed) > 0, "both move the tool ahead"
