"""The agent that keeps out of what the scan did not see."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from seen_helpers import seen_where

from greenhouse_gym.agents import CarefulAgent, Problem, WaypointAgent, careful
from greenhouse_gym.agents.agent import Agent
from greenhouse_gym.agents.careful import Care
from greenhouse_gym.envs import GreenhouseEnv
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.margins import with_margin
from greenhouse_gym.motion.unknown_space import guarded
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, compile_scene

ARM = get_robot("ur5e")
TARGET = 4


def played(agent: Agent, scene: Scene) -> tuple[bool, np.ndarray]:
    """Whether an agent reaches the target, and (steps, joints) the commands on its way, radians."""
    env = GreenhouseEnv(bank="mini", **agent.env_options)
    observation, info = env.reset(options={"scene": scene, "target": TARGET})
    problem = Problem(scene, TARGET, ARM, env.start)
    agent.reset(problem)
    commands = [env.start]
    over = False
    while not over:
        action = agent.act(observation)
        commands.append(commands[-1] + action * problem.joint_steps)
        observation, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    env.close()
    return bool(info["is_success"]), np.array(commands)


def test_it_stays_where_the_scan_saw_that_there_is_room(scene: Scene) -> None:
    partly = seen_where(scene, 1.7, aisle=0.3)
    checker = CollisionChecker(planning_model(guarded(partly, ARM, ARM.start), TARGET, margin=0.0))
    agent = CarefulAgent([0.0, 0.1])
    reached, commands = played(agent, partly)
    assert (reached, agent.status) == (True, "0")
    assert all(checker.is_free(command) for command in commands)


@pytest.mark.parametrize("seen", [0.0, None], ids=["nothing was seen", "it is not said what was seen"])
def test_where_there_is_no_other_way_it_goes_as_if_all_were_free(scene: Scene, seen: float | None) -> None:
    known = scene if seen is None else seen_where(scene, seen)
    agent = CarefulAgent()
    (reached, commands), (also, others) = played(agent, known), played(WaypointAgent(), known)
    assert (reached, agent.status) == (also, "inf") == (True, "inf")
    np.testing.assert_allclose(commands, others, atol=1e-5)


@pytest.mark.parametrize(
    ("free_from", "found", "searched"),
    [
        (0.0, 0.1, [0.1]),
        (0.2, 0.2, [0.1, np.inf, 0.15, 0.2]),
        (np.inf, np.inf, [0.1, np.inf, 0.15, 0.2]),
        (None, np.inf, [0.1, np.inf]),
    ],
    ids=["at once", "deeper", "at the last alone", "nowhere"],
)
def test_what_the_last_care_leaves_closed_is_not_searched_again(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, free_from: float | None, found: float, searched: list[float]
) -> None:
    tried: list[float] = []

    def ways(depth: float, ends: object) -> SimpleNamespace:
        tried.append(depth)
        return SimpleNamespace(nodes=SimpleNamespace(reach=free_from is not None and depth >= free_from), depth=depth)

    monkeypatch.setattr(careful, "guarded", lambda scene, robot, start, depth: depth)
    monkeypatch.setattr(careful, "Place", lambda depth: depth)
    monkeypatch.setattr(careful, "Ways", ways)
    partly = seen_where(scene, 1.7)
    ends = careful.ends_of(Problem(scene, TARGET, ARM, ARM.start), ARM.start)
    best, care = careful.careful_ways(partly, ARM, ends, [Care(0.0, depth) for depth in (0.1, 0.15, 0.2, np.inf)])
    assert (best.depth, care, tried) == (found, Care(0.0, found), searched)  # type: ignore[attr-defined]


@pytest.mark.parametrize("asked", [0.02, 0.3], ids=["there is room", "there is none"])
def test_ways_keep_from_boxes_where_there_is_room(scene: Scene, asked: float) -> None:
    beside = Box(scene.tomatoes[TARGET].center - [0.1, 0.15, 0.0], [0.02, 0.02, 0.02], np.eye(3))
    leafy = scene.model_copy(update={"clutter": (*scene.clutter, beside)})
    ends = careful.ends_of(Problem(leafy, TARGET, ARM, ARM.start), ARM.start)
    ways, care = careful.careful_ways(leafy, ARM, ends, [Care(asked, 0.1), Care(0.0, 0.1), Care(0.0, np.inf)])
    assert care == Care(0.02 if asked == 0.02 else 0.0, np.inf), "the scene does not say what was seen of it"
    around = with_margin(leafy, ARM, ARM.start, care.margin)
    checker = CollisionChecker(planning_model(compile_scene(around, ARM), TARGET, margin=0.0))
    at, left = ARM.start, np.inf
    while left > 0:
        heading = ways.heading(at)
        assert heading.free
        assert checker.motion_is_free(at, heading.waypoint, 0.005)
        at, left = heading.waypoint, heading.left


def test_depths_count_from_the_least_on_in_any_order() -> None:
    assert CarefulAgent([0.2, 0.1, np.inf])._cares == [Care(0.0, 0.1), Care(0.0, 0.2), Care(0.0, np.inf)]


@pytest.mark.parametrize("depths", [[], [-0.1], [float("nan")]])
def test_depths_without_a_meaning_are_refused(depths: list[float]) -> None:
    with pytest.raises(InvalidValueError, match="depth"):
        CarefulAgent(depths)


def test_it_says_so_where_it_was_not_reset() -> None:
    with pytest.raises(RuntimeError, match="reset"):
        CarefulAgent().act(None)
