"""The agent without a scan: it must not know what only a scan could tell it."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.agents import Problem
from greenhouse_gym.agents.exploring import ExploringAgent, unscanned
from greenhouse_gym.envs import GreenhouseEnv
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene

ARM = get_robot("ur5e")
TARGET = 4


def played(told: Scene, true: Scene) -> tuple[bool, list[np.ndarray]]:
    """Whether the target of a scene is reached by an agent that is told another one, and its actions."""
    agent, actions = ExploringAgent(), []
    env = GreenhouseEnv(bank="mini", **agent.env_options)
    observation, info = env.reset(options={"scene": true, "target": TARGET})
    agent.reset(Problem(told, TARGET, ARM, env.start, seed=5))
    over = False
    while not over:
        actions.append(agent.act(observation))
        observation, _, terminated, truncated, info = env.step(actions[-1])
        over = terminated or truncated
    env.close()
    assert agent.status, "it says how often it looked for a way"
    return bool(info["is_success"]), actions


def test_it_reaches_a_target_in_a_scene_that_it_was_told_nothing_of(scene: Scene) -> None:
    reached, actions = played(scene, scene)
    assert reached
    bare = scene.model_copy(update={"stems": (), "clutter": (), "seen": None})
    same, without = played(bare, scene)
    assert same
    assert np.array_equal(actions, without), "the scan's shapes and what it saw change nothing"


def test_what_is_known_without_a_scan_is_the_target_and_the_stand(scene: Scene) -> None:
    known = unscanned(scene, TARGET, ARM)
    assert known.tomatoes == (scene.tomatoes[TARGET],)
    assert (known.stems, known.clutter, known.truth) == ((), (), None)
    assert known.stand == scene.stand
    assert known.seen is not None
    assert not known.seen(known.seen.centers.reshape(-1, 3)).any()


def test_it_must_be_reset_before_it_acts() -> None:
    with pytest.raises(RuntimeError, match="reset"):
        ExploringAgent().act({})
