from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

import torch

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.envs import GreenhouseEnv
from greenhouse_gym.envs.state import STEP_LIMIT
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.learning.sac import GoalReplayBuffer
from greenhouse_gym.learning.sb3 import make_sb3_vec_env
from greenhouse_gym.learning.sb3_features import GoalFeatures
from greenhouse_gym.motion.success import SUCCESS_RADIUS
from greenhouse_gym.scene import Scene, SceneBank


def filled(
    bank: SceneBank, reward: str, steps: int, drift: float = 1.0, action: str = "tip_velocity"
) -> GoalReplayBuffer:
    """A buffer with what two arms did that each wander in a direction of their own."""
    env = make_sb3_vec_env(2, bank=bank, observation="goal", action=action, reward=reward, seed=0)
    buffer = GoalReplayBuffer(1000, env.observation_space, env.action_space, env, n_envs=2, device="cpu")
    random, seen = np.random.default_rng(0), env.reset()
    actions = drift * random.uniform(-1, 1, (2, 6)).astype(np.float32)
    for _ in range(steps):
        following, rewards, dones, infos = env.step(actions)
        final = {key: values.copy() for key, values in following.items()}
        for i in np.flatnonzero(dones):
            for key, values in infos[i]["terminal_observation"].items():
                final[key][i] = values
        buffer.add(seen, final, actions, rewards, dones, infos)
        actions[dones] = drift * random.uniform(-1, 1, (int(dones.sum()), 6))
        seen = following
    return buffer


def virtual(buffer: GoalReplayBuffer) -> tuple[Any, np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Every kept transition of a whole episode once, in hindsight, and where it lies."""
    np.random.seed(0)  # noqa: NPY002 - the buffer draws from there
    at, who = np.nonzero(buffer.ep_length > 0)
    return buffer._get_virtual_samples(at, who), at, who


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_hindsight_pays_and_ends_as_the_environment_would_have(bank: SceneBank, reward: str) -> None:
    """The design's rewards by hand, from positions, actions and contacts."""
    buffer = filled(bank, reward, 500)
    samples, at, who = virtual(buffer)
    seen, following = samples.observations, samples.next_observations
    assert torch.equal(seen["desired_goal"], following["desired_goal"])
    goal = following["desired_goal"].numpy()
    before = np.linalg.norm(seen["achieved_goal"].numpy() - goal, axis=1)
    after = np.linalg.norm(following["achieved_goal"].numpy() - goal, axis=1)
    touched = np.array([info["collision"] for info in buffer.infos[at, who]])
    reached = (after < SUCCESS_RADIUS) & ~touched
    assert min(touched.sum(), reached.sum(), (~touched & ~reached).sum()) > 1
    np.testing.assert_array_equal(samples.dones.numpy().ravel(), touched | reached)  # no timeouts among them
    effort = (samples.actions.numpy().astype(np.float64) ** 2).sum(axis=1)
    expected = {
        "sparse": 1.0 * reached - touched,
        "dense": 10.0 * reached - 5.0 * touched + 4.0 * (before - after) - 0.02 - 0.003 * effort,
    }[reward]
    np.testing.assert_allclose(samples.rewards.numpy().ravel(), expected, atol=1e-5)


def test_what_a_real_goal_pays_is_what_hindsight_pays_for_the_same(bank: SceneBank) -> None:
    buffer = filled(bank, "dense", 500)
    at, who = np.nonzero(buffer.ep_length > 0)
    buffer._sample_goals = lambda at, who: buffer.observations["desired_goal"][at, who]  # type: ignore[method-assign]
    again, real = buffer._get_virtual_samples(at, who), buffer._get_real_samples(at, who)
    assert torch.equal(again.rewards, real.rewards)
    assert torch.equal(again.dones, real.dones)


def test_the_step_limit_is_no_end(bank: SceneBank) -> None:
    buffer = filled(bank, "dense", 2 * STEP_LIMIT + 1, drift=0.0)  # standing still
    samples, at, who = virtual(buffer)
    assert buffer.timeouts.sum() == 4
    real = buffer._get_real_samples(at, who)
    assert buffer.dones[at, who].sum() == 4
    assert real.dones.sum() == 0
    assert (samples.dones.numpy().ravel() == 1).all()  # where it stands is the only goal there is


@pytest.mark.parametrize("action", ["joint", "tip_velocity"])
def test_transitions_seldom_begin_at_their_goal(bank: SceneBank, action: str) -> None:
    """An arm that only turns its tip stays within one radius to the end, where no goal lies elsewhere."""
    buffer = filled(bank, "sparse", 600, drift=0.1, action=action)  # slow: several steps within one radius
    samples, at, who = virtual(buffer)
    here, after = buffer.observations["achieved_goal"], buffer.next_observations["achieved_goal"]
    left = buffer.ep_length[at, who] - (at - buffer.ep_start[at, who]) % buffer.buffer_size
    futures = ((k + np.arange(steps)) % buffer.buffer_size for k, steps in zip(at, left, strict=True))
    ways = [after[future, i] - here[k, i] for future, k, i in zip(futures, at, who, strict=True)]
    free = np.array([np.linalg.norm(way, axis=1).max() > SUCCESS_RADIUS for way in ways])

    def begins(goals: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.linalg.norm(goals - here[at, who], axis=1) < SUCCESS_RADIUS

    chosen, plain = (
        begins(samples.observations["desired_goal"].numpy()),
        begins(super(GoalReplayBuffer, buffer)._sample_goals(at, who)),
    )
    assert free.mean() > 0.7
    assert chosen[free].mean() < 0.4 * plain[free].mean()
    assert chosen[~free].all()


def test_features_know_the_target_from_other_fruit(scene: Scene) -> None:
    env = GreenhouseEnv(observation="goal", bank="mini")
    features = GoalFeatures(env.observation_space, env.simulation.observe.layout)  # type: ignore[arg-type]
    reset = {"scene": scene, "target": 0, "start": [0.3, -1.2, 1.6, -1.9, -0.4, 0.2]}
    seen, _ = env.reset(options=reset)
    origin = scene.tomatoes[0].center - seen["desired_goal"]
    ahead = origin + seen["achieved_goal"] + 0.05 * env.simulation.state.axis[0]  # type: ignore[union-attr]
    fruit = (Tomato(Sphere(ahead, 0.03), truss=0), Tomato(Sphere(ahead + [0, 0.4, 0], 0.03), truss=0))
    placed = scene.model_copy(update={"tomatoes": fruit, "stems": (), "clutter": (), "targets": ()})
    told = []
    for target in (0, 1):
        seen, info = env.reset(options={**reset, "scene": placed, "target": target})
        result = features({key: torch.as_tensor(values)[None] for key, values in seen.items()})[0].numpy()
        assert result.shape == (features.features_dim,)
        assert np.abs(result).max() < 10
        np.testing.assert_allclose(result[-6], 2.0 * info["distance"], rtol=1e-5)
        np.testing.assert_allclose(result[-4], 10 * 0.03, atol=1e-4)
        told.append(result[-2])
    assert abs(told[0]) < 0.2  # 2 cm: the nearest obstacle is the target
    assert told[1] < -2
