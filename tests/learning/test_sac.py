from __future__ import annotations

import pytest

pytest.importorskip("stable_baselines3")

import torch

from greenhouse_gym.errors import UnknownNameError
from greenhouse_gym.learning.sac import SacProgress, SacSettings, make_sac, train_sac
from greenhouse_gym.scene import SceneBank


@pytest.fixture
def settings(bank: SceneBank) -> SacSettings:
    return SacSettings(
        bank=str(bank.path), num_envs=4, updates_per_step=1, batch_size=16, random_steps=900, hidden=(16,), threads=1
    )


def test_training_is_judged_now_and_then(settings: SacSettings) -> None:
    told: list[SacProgress] = []
    model, curve = train_sac(settings, 1000, every=500, episodes=4, tell=told.append)
    assert told == curve
    assert [row.steps for row in curve] == [500, 1000]
    assert [row.updates for row in curve] == [0, 24]
    assert 0 < curve[0].seconds < curve[1].seconds
    validation = set(SceneBank.open(settings.bank).names("validation"))
    assert {record.scene for row in curve for record in row.validation.records} <= validation, (
        "the test split is for the end"
    )
    assert all(len(row.validation.records) == 4 and row.validation.median("steps") > 0 for row in curve)
    assert model.num_timesteps == 1000


def test_the_same_seed_learns_the_same(settings: SacSettings) -> None:
    first, second = (train_sac(settings, 940, every=10**9)[0].policy.state_dict() for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)
    other = make_sac(SacSettings(**{**vars(settings), "seed": 1})).policy.state_dict()
    assert any(not torch.equal(first[name], other[name]) for name in first)


def test_it_stops_in_time(settings: SacSettings) -> None:
    model, curve = train_sac(settings, 10**9, minutes=0.0)
    assert model.num_timesteps <= 4
    assert curve == []


def test_an_unknown_reward_is_refused(settings: SacSettings) -> None:
    with pytest.raises(UnknownNameError, match="dense"):
        make_sac(SacSettings(**{**vars(settings), "reward": "shaped"}))


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_it_learns_to_reach_without_touching() -> None:
    """Some five minutes of one core: random actions reach 0 % (and collide seldom, for they hardly get anywhere)."""
    _, (first, last) = train_sac(SacSettings(threads=1), 40_000, every=20_000, episodes=128)
    for before, after in ((first.train, last.train), (first.validation, last.validation)):
        assert after.success_rate > max(before.success_rate, 0.05)
    assert last.train.collision_rate < first.train.collision_rate
