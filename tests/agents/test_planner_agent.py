from __future__ import annotations

import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from still_agent import StillAgent

from greenhouse_gym.agents import (
    Agent,
    PlannerAgent,
    Problem,
    RandomAgent,
    StraightLineAgent,
    planner_agent,
)
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.planning import CollisionChecker, PlanResult, plan, planning_model
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.mjcf import compile_scene

ARM = get_robot("ur5e")
START = ARM.starts["upright"]


def problem(scene: Scene, target: int, seed: int = 0) -> Problem:
    return Problem(scene, target, ARM, START, seed)


@pytest.mark.parametrize("make", [PlannerAgent, RandomAgent, StillAgent, StraightLineAgent])
def test_every_agent_keeps_the_protocol(scene: Scene, make: type) -> None:
    agent = make()
    assert isinstance(agent, Agent)
    agent.reset(problem(scene, 0))
    action = agent.act(np.zeros(60))
    assert action.shape == (6,)
    assert action.dtype == np.float32
    assert np.abs(action).max() <= 1 + 1e-6
    first = [agent.act(None) for _ in range(5)]
    agent.reset(problem(scene, 0))
    agent.act(None)
    assert np.array_equal(first, [agent.act(None) for _ in range(5)]), "same seed, other actions"


def test_planned_paths_are_executed_without_contact(bank: SceneBank) -> None:
    """Every target of two scenes, through the environment's steps: what the planner calls free the simulator does."""
    env = gymnasium.make("TomatoReach-v0", bank=bank, start="upright", action="joint")
    agent = PlannerAgent()
    steps = []
    for name in bank.names("test"):
        scene = bank.scene(name)
        compiled = compile_scene(scene)
        for target in range(len(scene.tomatoes)):
            observation, info = env.reset(seed=0, options={"scene": name, "target": target})
            agent.reset(problem(scene, target))
            assert agent.status == "solved"
            simulator = CollisionChecker(planning_model(compiled, target, margin=0.0))
            for step in range(1, 201):
                observation, _, terminated, truncated, info = env.step(agent.act(observation))
                assert not info["collision"], (name, target, step, info["contact"])
                assert simulator.is_free(env.unwrapped.simulation.state.joints[0])  # type: ignore[attr-defined]
                if terminated or truncated:
                    break
            assert info["is_success"], (name, target)
            steps.append(step)
    assert len(steps) == 24
    assert np.median(steps) < 80
    env.close()


def test_without_a_path_it_stays_still(scene: Scene) -> None:
    far = scene.model_copy(update={"tomatoes": (Tomato(Sphere([3.0, 0.0, 1.0], 0.03), truss=0),)})
    agent = PlannerAgent()
    assert agent.status == ""
    agent.reset(problem(far, 0))
    assert agent.status == "no_goal"
    assert not agent.act(None).any()


def test_it_begins_anew_from_other_seeds_until_there_is_a_path(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def only_from_seven(*given: Any, seed: int, **named: Any) -> PlanResult:
        asked.append(seed)
        goals = given[6] if seed == 7 else np.zeros((0, 6))
        return plan(*given[:6], goals, seed=seed, **named)

    monkeypatch.setattr(planner_agent, "plan", only_from_seven)
    for attempts, seeds, status in ((1, [5], "no_goal"), (2, [5, 6], "no_goal"), (4, [5, 6, 7], "solved")):
        agent, asked[:] = PlannerAgent(attempts=attempts), []
        agent.reset(problem(scene, 0, seed=5))
        assert (asked, agent.status) == (seeds, status)
    for wrong in (0, -1, 1.5, True):
        with pytest.raises(InvalidValueError, match=f"attempts must be a whole number from 1 up, got {wrong}"):
            PlannerAgent(attempts=wrong)  # type: ignore[arg-type]


def test_it_starts_where_it_is_told(scene: Scene) -> None:
    start = START + [0.4, 0.1, 0.3, 0.0, 0.2, 0.0]
    agent = PlannerAgent()
    agent.reset(Problem(scene, 0, ARM, start))
    assert agent.result is not None
    assert agent.result.path is not None
    assert np.array_equal(agent.result.path[0], start)


def test_mistakes_are_told() -> None:
    with pytest.raises(UnknownNameError, match="RRTConnect"):
        PlannerAgent("RRTConect")
    with pytest.raises(RuntimeError, match="reset"):
        PlannerAgent().act(None)
    import greenhouse_gym.agents as agents

    with pytest.raises(AttributeError, match="Nobody"):
        agents.Nobody  # noqa: B018
    assert agents.PolicyAgent.__name__ == "PolicyAgent"


def test_agents_load_neither_torch_nor_ompl() -> None:
    import subprocess

    code = "import sys, greenhouse_gym.agents, greenhouse_gym.evaluation; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"torch", "ompl", "open3d", "cv2", "stable_baselines3"} & set(run.stdout.split())
