from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("ompl")

from greenhouse_gym.agents import PolicyAgent
from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.envs import GreenhouseVectorEnv
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.geometry import distance_to_shapes
from greenhouse_gym.learning.imitation import (
    BcThenPpoSettings,
    ImitationSettings,
    Variation,
    follow_waypoint,
    imitate,
    train_bc_then_ppo,
    varied_bank,
    varied_scene,
)
from greenhouse_gym.learning.ppo import PpoSettings, make_ppo, train_ppo
from greenhouse_gym.learning.sb3 import make_sb3_vec_env
from greenhouse_gym.scene import Scene, SceneBank

STILL = Variation(PlantMotion(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)


def test_a_mirror_image_keeps_all_distances(scene: Scene) -> None:
    point = np.array([[0.4, 0.15, 1.2]])
    images = [varied_scene(scene, np.random.default_rng(seed), "image", STILL) for seed in range(8)]
    mirrored = [image for image in images if image.tomatoes[0].center[1] == -scene.tomatoes[0].center[1]]
    assert 0 < len(mirrored) < 8
    for image in mirrored:
        at_mirror = distance_to_shapes(point * [1, -1, 1], image.obstacles)
        np.testing.assert_allclose(at_mirror, distance_to_shapes(point, scene.obstacles), atol=1e-9)


def test_targets_stay_the_tomatoes_that_they_were(scene: Scene) -> None:
    thin = varied_scene(scene, np.random.default_rng(3), "thin", Variation(STILL.plants, STILL.shift, 0.9, False))
    assert 0 < len(thin.tomatoes) < len(scene.tomatoes)
    assert [target.tomato for target in thin.targets] == list(range(len(thin.tomatoes)))
    centers = {tuple(tomato.center) for tomato in scene.tomatoes}
    assert {tuple(tomato.center) for tomato in thin.tomatoes} < centers


def test_only_training_scenes_are_varied(bank: SceneBank, tmp_path: Path) -> None:
    varied = varied_bank(bank, tmp_path, 5)
    assert len(varied.names("train")) == len(bank.names("train")) + 5
    assert varied.names("test") == bank.names("test")
    assert varied_bank(bank, tmp_path / "again", 5).sha256 == varied.sha256


def test_the_learner_comes_to_do_as_the_teacher_does(bank: SceneBank) -> None:
    settings = PpoSettings(bank=str(bank.path), num_envs=2, hidden=(64, 64), threads=1)
    model = make_ppo(settings, make_sb3_vec_env(2, bank=bank, observation="roadmap", action="joint", threads=1))
    env = GreenhouseVectorEnv(4, bank=bank, observation="roadmap", action="joint", threads=1, autoreset_mode="SameStep")
    told: list[dict[str, float]] = []
    imitation = ImitationSettings(steps=240, num_envs=4, round_steps=20, batch_size=64, passes=100)
    imitate(model.policy, env, imitation, on_progress=lambda steps, figures: told.append(figures))
    assert [figures["labels"] > 60 * (k + 1) for k, figures in enumerate(told)] == [True] * 3
    assert told[0]["loss"] < 0.2, "labels are numbers from -1 to 1, and mostly far from 0"


def test_an_untrained_policy_can_follow_waypoints_exactly(bank: SceneBank) -> None:
    settings = PpoSettings(hidden=(24, 16))
    env = make_sb3_vec_env(2, bank=bank, observation="roadmap", action="joint", threads=1)
    model = make_ppo(settings, env)
    follow_waypoint(model.policy)
    seen = env.reset()
    seen[1, -1] = 0.0
    np.testing.assert_allclose(model.predict(seen, deterministic=True)[0], seen[:, -8:-2] * [[1.0], [0.0]], atol=1e-6)
    assert seen[0, -1] == 1.0
    assert np.abs(seen[:, -8:-2]).max(axis=1).min() > 0.5
    with pytest.raises(InvalidValueError, match="relu"):
        follow_waypoint(make_ppo(PpoSettings(activation="tanh"), env).policy)


def test_imitation_then_ppo_leaves_a_policy_that_plays(bank: SceneBank, tmp_path: Path) -> None:
    ppo = PpoSettings(
        bank=str(bank.path), observation="roadmap", action="joint", activation="relu", num_envs=4, rollout_steps=8,
        batch_size=16, epochs=1, total_steps=64, hidden=(16,), critic_rollouts=1, threads=1,
    )  # fmt: skip
    imitation = ImitationSettings(steps=32, num_envs=4, round_steps=8, batch_size=16, passes=1)
    path = train_bc_then_ppo(BcThenPpoSettings(3, imitation, ppo), tmp_path)
    agent = PolicyAgent.load(path)
    assert agent.env_options["observation"] == "roadmap"
    assert len(evaluate(agent, "validation", 2, bank=bank, num_envs=2).records) == 2


def test_a_network_may_begin_from_nothing(bank: SceneBank, tmp_path: Path) -> None:
    ppo = PpoSettings(
        bank=str(bank.path), observation="roadmap", action="joint", num_envs=2, total_steps=0, hidden=(16, 16),
        threads=1,
    )  # fmt: skip
    nothing = ImitationSettings(steps=0)
    seen = make_sb3_vec_env(2, bank=bank, observation="roadmap", action="joint", threads=1).reset()
    follows = {}
    for from_rule in (True, False):
        path = train_bc_then_ppo(BcThenPpoSettings(0, nothing, ppo, from_rule), tmp_path / str(from_rule))
        action = PolicyAgent.load(path).policy(seen)
        follows[from_rule] = bool(np.allclose(action, seen[:, -8:-2], atol=1e-5))
    assert follows == {True: True, False: False}


def test_at_first_the_critic_alone_learns(bank: SceneBank, tmp_path: Path) -> None:
    settings = PpoSettings(
        bank=str(bank.path), num_envs=4, rollout_steps=8, batch_size=16, epochs=1, total_steps=64, hidden=(16,),
        critic_rollouts=2, threads=1,
    )  # fmt: skip
    kept: list[object] = []
    train_ppo(settings, tmp_path, prepare=lambda model: kept.append((model, _copied(model))))
    [(model, before)] = kept  # type: ignore[misc]
    after = _copied(model)
    changed = {name for name, values in before.items() if not np.array_equal(values, after[name])}
    assert changed
    assert all("value" in name for name in changed)


def _copied(model: object) -> dict[str, np.ndarray]:
    return {name: value.detach().numpy().copy() for name, value in model.policy.named_parameters()}  # type: ignore[attr-defined]
