"""Copies of environments, as search methods make them, go on by themselves from the same state."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import numpy as np
import pytest
from test_vector import equal

from greenhouse_gym.envs import GreenhouseEnv, GreenhouseVectorEnv, Randomization
from greenhouse_gym.scene import SceneBank

KINDS: list[dict[str, Any]] = [
    {},
    {"robot": "iiwa14", "observation": "goal", "step_limit": 40},
    {"observation": "depth", "randomization": Randomization(0.03, 0.05, 0.02, 0.01, depth_noise=True)},
    {"observation": "roadmap"},
    {"task": "look", "observation": "task", "randomization": Randomization(depth_noise=True)},
    {"render_mode": "rgb_array"},
]


def go_on(env: Any, actions: np.ndarray) -> list[Any]:
    seen: list[Any] = []
    for action in actions:
        seen.append(env.step(action))
        if np.all(seen[-1][2] | np.asarray(seen[-1][3])):
            seen.append(env.reset())
    return seen


def same(one: list[Any], other: list[Any]) -> bool:
    return all(equal(a, b) for x, y in zip(one, other, strict=True) for a, b in zip(x, y, strict=True))


def towards_the_plants(count: int, shape: tuple[int, ...]) -> np.ndarray:
    actions = np.random.default_rng(1).uniform(-0.4, 0.4, (count, *shape))
    actions[..., 0] += 0.5
    return actions


@pytest.mark.parametrize("keywords", KINDS, ids=str)
def test_a_copy_goes_on_like_the_original_and_leaves_it_alone(keywords: dict[str, Any], bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank, **keywords)
    env.reset(seed=3)
    actions = towards_the_plants(70, env.action_space.shape)
    go_on(env, actions[:10])
    first, second = copy.deepcopy(env), copy.deepcopy(env)
    one = go_on(first, actions[10:])
    assert any(isinstance(step[1], dict) for step in one)  # an episode ended, and another one was drawn
    assert same(one, go_on(second, actions[10:]))
    assert same(one, go_on(env, actions[10:]))
    assert first.scene is env.scene
    assert first.simulation.worlds is env.simulation.worlds


def test_a_copy_of_a_copy_of_a_wrapped_environment(bank: SceneBank) -> None:
    env = gymnasium.make("TomatoReach-v0", bank=bank)
    fresh = copy.deepcopy(env)
    env.reset(seed=1)
    twin = copy.deepcopy(copy.deepcopy(env))
    assert same(go_on(env, np.full((5, 6), 0.3)), go_on(twin, np.full((5, 6), 0.3)))
    assert equal(fresh.reset(seed=1)[0], env.reset(seed=1)[0])


def test_difficulties_of_a_copy_are_its_own(bank: SceneBank) -> None:
    env = GreenhouseEnv(bank=bank)
    twin = copy.deepcopy(env)
    twin.set_difficulty("hard")
    assert set(env.simulation.sampler.difficulty) == {"easy", "medium", "hard"}


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_copies_of_vector_environments_go_on_too(mode: str, bank: SceneBank) -> None:
    env = GreenhouseVectorEnv(3, bank=bank, autoreset_mode=mode)
    env.reset(seed=3)
    actions = towards_the_plants(60, (3, 6))
    for action in actions[:10]:
        env.step(action)
    twin = copy.deepcopy(env)
    ends = 0
    for action in actions[10:]:
        one, other = env.step(action), twin.step(action)
        ends += (one[2] | one[3]).sum()
        assert all(equal(a, b) for a, b in zip(one[:4], other[:4], strict=True))
        assert equal(one[4]["contact"], other[4]["contact"])
    assert ends > 2
