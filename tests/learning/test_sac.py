from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from greenhouse_gym.agents import PolicyAgent
from greenhouse_gym.agents.agent import check_agent
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError
from greenhouse_gym.learning import load_into
from greenhouse_gym.learning.sac import SacSettings, load_sac, make_sac, train_sac
from greenhouse_gym.learning.sb3 import Sb3Agent
from greenhouse_gym.learning.training_files import read_curve
from greenhouse_gym.learning.training_report import Validation
from greenhouse_gym.scene import SceneBank

NEVER = 10**9


@pytest.fixture
def settings(bank: SceneBank) -> SacSettings:
    return SacSettings(
        bank=str(bank.path), num_envs=4, updates_per_step=1, batch_size=16, random_steps=900, hidden=(16,), threads=1,
        memory=10_000, total_steps=1000, validation_steps=500, validation_episodes=4,
    )  # fmt: skip


def test_training_validates_at_intervals(settings: SacSettings, tmp_path: Path) -> None:
    curve: list[Validation] = []
    path = train_sac(settings, tmp_path, on_progress=curve.append)
    assert [row.steps for row in curve] == [500, 1000]
    assert [row.updates for row in curve] == [0, 24]
    assert 0 < curve[0].seconds < curve[1].seconds
    validation = set(SceneBank.open(settings.bank).names("validation"))
    assert {record.scene for row in curve for record in row.results["validation"].records} <= validation, (
        "the test split is for the end"
    )
    assert all(
        len(row.results["validation"].records) == 4 and row.results["validation"].median("steps") > 0 for row in curve
    )
    assert path == tmp_path / "policy.json"
    assert len(read_curve(tmp_path / "curve.csv")) == 1
    rows = read_curve(tmp_path / "validation.csv")
    columns = ["steps", "updates", "seconds", "train_success_rate", "train_collision_rate", "success_rate"]
    assert [list(row) for row in rows] == [[*columns, "collision_rate"]] * 2
    assert [row["success_rate"] for row in rows] == [told.results["validation"].success_rate for told in curve]
    told = EventAccumulator(str(tmp_path / "tensorboard")).Reload().Tags()["scalars"]
    assert {"episodes/success_rate", "episodes/collision_rate", "validation/success_rate"} <= set(told)
    assert any(name.startswith("reward/") for name in told)


def weights(folder: Path) -> dict[str, Any]:
    state: dict[str, Any] = load_sac(folder).policy.state_dict()
    return state


def test_the_same_seed_learns_the_same(settings: SacSettings, tmp_path: Path) -> None:
    short = replace(settings, total_steps=940, validation_steps=NEVER)
    first, second = (weights(train_sac(short, tmp_path / name).parent) for name in ("first", "second"))
    assert all(torch.equal(first[name], second[name]) for name in first)
    other = make_sac(replace(settings, seed=1)).policy.state_dict()
    assert any(not torch.equal(first[name], other[name]) for name in first)


def test_it_stops_in_time(settings: SacSettings, tmp_path: Path) -> None:
    curve: list[Validation] = []
    train_sac(settings, tmp_path, time_limit=0.0, on_progress=curve.append)
    assert load_sac(tmp_path).num_timesteps <= 4
    assert curve == []


def test_a_training_goes_on_where_it_was(settings: SacSettings, tmp_path: Path) -> None:
    train_sac(settings, tmp_path)
    before = load_sac(tmp_path)
    check_agent(Sb3Agent(before))
    with pytest.raises(InvalidValueError, match="holds a training, which would be lost"):
        train_sac(settings, tmp_path)
    with pytest.raises(InvalidValueError, match="made with other settings: batch_size"):
        train_sac(replace(settings, batch_size=32), tmp_path, resume=True)
    told: list[Validation] = []
    train_sac(replace(settings, total_steps=2000, random_steps=900), tmp_path, resume=True, on_progress=told.append)
    after = load_sac(tmp_path)
    assert after.num_timesteps == 2000
    assert [row["steps"] for row in read_curve(tmp_path / "validation.csv")] == [500, 1000, 1500, 2000]
    assert [row.updates for row in told] == [25, 49], "it filled its memory before it learned on"
    assert told[0].seconds > read_curve(tmp_path / "validation.csv")[1]["seconds"]
    state = after.critic.optimizer.state_dict()["state"]
    assert {int(moment["step"]) for moment in state.values()} == {50}, "the optimizer remembers"
    assert float(before.log_ent_coef) != float(after.log_ent_coef) != float(make_sac(settings).log_ent_coef)


def test_an_interrupted_training_loses_nothing(settings: SacSettings, tmp_path: Path) -> None:
    def interrupt(told: Validation) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_sac(settings, tmp_path, on_progress=interrupt)
    assert load_sac(tmp_path).num_timesteps == 500
    train_sac(settings, tmp_path, resume=True)
    assert load_sac(tmp_path).num_timesteps == 1000


def test_there_must_be_something_to_go_on_with(settings: SacSettings, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match=r"nothing to resume: .* holds no checkpoint.safetensors"):
        train_sac(settings, tmp_path, resume=True)
    train_sac(replace(settings, total_steps=4, validation_steps=NEVER), tmp_path)
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(FileFormatError, match=r"checkpoint\.safetensors"):
        load_sac(tmp_path)


def test_an_unknown_reward_is_refused(settings: SacSettings) -> None:
    with pytest.raises(UnknownNameError, match="dense"):
        make_sac(replace(settings, reward="shaped"))


def test_too_few_random_steps_are_refused(settings: SacSettings, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="random_steps must be at least 800"):
        train_sac(replace(settings, random_steps=799), tmp_path)
    assert not list(tmp_path.iterdir())


def test_guidance_needs_actions_of_the_joints(settings: SacSettings) -> None:
    with pytest.raises(InvalidValueError, match='guided follows waypoints of the joints: choose action="joint"'):
        make_sac(replace(settings, guided=True, observation="goal_roadmap"))


def test_guided_steps_fill_the_memory_with_what_the_waypoint_says(settings: SacSettings, tmp_path: Path) -> None:
    guided = replace(settings, observation="goal_roadmap", action="joint", guided=True, reward="sparse")
    model = make_sac(guided)
    model.learn(2_100)
    kept = model.replay_buffer
    seen = torch.from_numpy(kept.observations["observation"][:200])
    straight = seen[:, :, -8:-2] * seen[:, :, -1:]
    noise = [float((torch.from_numpy(kept.actions[:200, i]) - straight[:, i]).abs().mean()) for i in range(4)]
    assert noise[0] < 1e-6, "the first simulation does exactly what the waypoint says"
    assert noise == sorted(noise)
    assert noise[3] > 0.1
    assert kept.rewards[:200, 0].max() == 1.0, "it reaches some target"
    before = distance(make_sac(guided), kept)
    assert distance(model, kept) < 0.5 * before, "its actor is constrained towards them"
    with pytest.raises(InvalidValueError, match='guided needs observation="goal_roadmap"'):
        train_sac(replace(guided, observation="goal"), tmp_path)
    for wrong in (-1.0, float("nan"), float("inf")):
        with pytest.raises(InvalidValueError, match=f"guide_weight must be a finite number from 0 on, got {wrong}"):
            train_sac(replace(guided, guide_weight=wrong), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("observation", ["goal", "goal_roadmap"])
def test_what_it_learned_is_a_policy_file(settings: SacSettings, tmp_path: Path, observation: str) -> None:
    """The policy acts as the model does, alone and in a batch, and its weights fit another model."""
    short = replace(settings, observation=observation, total_steps=940, validation_steps=NEVER)
    model = load_sac(train_sac(short, tmp_path).parent)
    agent = PolicyAgent.load(tmp_path / "policy.json")
    assert agent.env_options["observation"] == observation
    assert agent.policy.training["settings"]["random_steps"] == 900
    env = model.get_env()
    seen = env.reset()
    for _ in range(60):
        expected, _ = model.predict(seen, deterministic=True)
        np.testing.assert_allclose(agent.act_many(seen), expected, atol=1e-5)
        one = {name: part[1] for name, part in seen.items()}
        np.testing.assert_array_equal(agent.act(one), agent.act_many(seen)[1])
        seen = env.step(env.action_space.sample()[None].repeat(4, axis=0))[0]
    for wrong in (seen["observation"], {"observation": seen["observation"]}):
        with pytest.raises(InvalidValueError, match="expected a goal environment's observation"):
            agent.act(wrong)
    other = make_sac(replace(short, seed=1))
    assert np.abs(other.predict(seen, deterministic=True)[0] - agent.act(seen)).max() > 1e-2
    load_into(other, agent.policy)
    np.testing.assert_allclose(other.predict(seen, deterministic=True)[0], agent.act(seen), atol=1e-5)
    with pytest.raises(InvalidValueError, match="layers of"):
        load_into(make_sac(replace(short, hidden=(8,))), agent.policy)


def distance(model: Any, memory: Any) -> float:
    """Return the mean squared distance of a guided model's actions to the demonstrator's, on a replay buffer."""
    seen = {name: torch.from_numpy(part[:200, 1]) for name, part in memory.observations.items()}
    with torch.no_grad():
        return float(((model.actor(seen, deterministic=True) - model.demonstrator.actions(seen)) ** 2).mean())


@pytest.fixture(scope="module")
def curve(tmp_path_factory: pytest.TempPathFactory) -> list[Validation]:
    """Validations after each 20,000 of 60,000 steps: some eight minutes of one core."""
    found: list[Validation] = []
    settings = SacSettings(threads=1, total_steps=60_000, validation_episodes=128)
    train_sac(settings, tmp_path_factory.mktemp("sac"), on_progress=found.append)
    return found


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.xfail(reason="after 40,000 steps 11 % of the rows that it trains on, 0 % of the others in the small bank")
def test_it_learns_to_reach_without_touching(curve: list[Validation]) -> None:
    """Random actions reach 0 % (and collide seldom, for they hardly get anywhere)."""
    first, last = curve[:2]
    for split, before in first.results.items():
        after = last.results[split]
        assert after.success_rate > max(before.success_rate, 0.05)
    assert last.results["train"].collision_rate < first.results["train"].collision_rate


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_it_learns_to_reach_in_the_rows_that_it_trains_on(curve: list[Validation]) -> None:
    before, after = curve[0].results["train"], curve[-1].results["train"]
    assert after.success_rate > max(before.success_rate, 0.2)
    assert after.collision_rate < before.collision_rate
