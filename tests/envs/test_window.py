"""Large banks: few scenes at a time stay ready, all have their turn, memory is bounded, a seed draws the same."""

from __future__ import annotations

import copy
import gc
import pickle
import weakref
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from greenhouse_gym.envs import GreenhouseEnv, GreenhouseVectorEnv, episodes
from greenhouse_gym.envs.episodes import EpisodeSampler, SceneWindow
from greenhouse_gym.envs.worlds import Worlds
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import SceneBank
from greenhouse_gym.scene import bank as bank_module


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows of four scenes that move on after eight draws."""
    for name, value in (("LARGEST_WHOLE", 5), ("WINDOW", 4), ("DRAWS_PER_SCENE", 8)):
        monkeypatch.setattr(episodes, name, value)


def names(count: int) -> list[str]:
    return [f"scene-{k}" for k in range(count)]


def drawn(draws: SceneWindow, count: int, seed: int = 0) -> list[str]:
    random = np.random.default_rng(seed)
    return [draws.draw(random) for _ in range(count)]


def test_a_small_bank_is_drawn_from_as_ever(small: None) -> None:
    random = np.random.default_rng(3)
    expected = [f"scene-{random.integers(5)}" for _ in range(50)]
    draws = SceneWindow(names(5))
    draws.restart(7)
    assert drawn(draws, 50, seed=3) == expected


def test_few_scenes_at_a_time_and_all_in_turn(small: None) -> None:
    draws = SceneWindow(names(20))
    draws.restart(1)
    met = drawn(draws, 20 * 8)
    assert 2 <= len(set(met[:8])) <= 4
    for k in range(0, len(met), 8):
        assert len(set(met[k : k + 8])) <= 4
    assert len(set(met)) == 20
    per_scene = Counter(drawn(draws, 20 * 8 * 20))
    assert set(per_scene) == set(names(20))
    assert max(per_scene.values()) < 2 * min(per_scene.values())


def test_the_seed_decides_on_the_order(small: None) -> None:
    draws = SceneWindow(names(20))
    draws.restart(1)
    first = drawn(draws, 100)
    draws.restart(1)
    assert drawn(draws, 100) == first
    draws.restart(2)
    assert drawn(draws, 100) != first
    unseeded = [drawn(SceneWindow(names(20)), 100, seed=5) for _ in range(2)]
    assert unseeded[0] == unseeded[1]


def test_a_sampler_draws_the_same_after_the_same_seed_whatever_was_drawn_before(
    small: None, bank: SceneBank, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(episodes, "LARGEST_WHOLE", 2)
    monkeypatch.setattr(episodes, "WINDOW", 2)
    sampler = EpisodeSampler(bank, "train", get_robot("ur5e"), "easy")

    def sampled(seed: int) -> list[tuple[str, tuple[int, ...]]]:
        sampler.restart(seed)
        random = np.random.default_rng(seed)
        return [(episode.scene.name, episode.targets) for episode in (sampler.draw(random) for _ in range(60))]

    first = sampled(0)
    assert {name for name, _ in first} == set(bank.names("train"))
    assert len({name for name, _ in first[:8]}) <= 2
    assert sampled(1) != first
    assert sampled(0) == first
    twins = sampler, copy.deepcopy(sampler)
    draws = [[twin.draw(np.random.default_rng(k)).scene.name for k in range(40)] for twin in twins]
    assert draws[0] == draws[1]


def test_seeded_resets_begin_the_window_anew(bank: SceneBank, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int] = []
    monkeypatch.setattr(EpisodeSampler, "restart", lambda self, seed: seeds.append(seed))
    single, vector = GreenhouseEnv(bank=bank), GreenhouseVectorEnv(2, bank=bank)
    single.reset(seed=4)
    single.reset()
    vector.reset(seed=5)
    vector.reset()
    vector.reset(seed=[None, 7], options={"reset_mask": np.array([False, True])})
    vector.reset(seed=[8, 9], options={"reset_mask": np.array([False, True])})
    assert seeds == [4, 5, 7, 9]


def test_of_a_large_bank_few_worlds_are_kept(bank: SceneBank) -> None:
    kept = Worlds(get_robot("ur5e"), "reconstruction", 300)
    for scene in bank[:2]:
        kept.world(scene, keep=1)
    gc.collect()
    assert len(kept.fields) == 1


def test_a_bank_keeps_the_scenes_that_were_asked_for_last(
    bank: SceneBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bank_module, "SCENES_KEPT", 3)
    opened = SceneBank(bank.path, bank.manifest)
    first = opened.scene(bank.names()[0])
    forgotten = weakref.ref(opened.scene(bank.names()[1]))
    for name in bank.names()[2:6]:
        opened.scene(name)
    assert opened.scene(first.name) is first  # still referenced
    assert forgotten() is None
    assert len(opened._scenes) == 3


def test_parts_and_unions_of_banks_travel(bank: SceneBank) -> None:
    part = bank.select(split="test")
    for one in (bank, part, SceneBank.join([part, bank.select(split="validation")])):
        there = pickle.loads(pickle.dumps(one))
        assert there.names() == one.names()
        assert there[0].model_dump_json() == one[0].model_dump_json()


def test_of_the_scenes_drawn_from_those_asked_for_last_are_kept(
    small: None, monkeypatch: pytest.MonkeyPatch, bank: SceneBank
) -> None:
    monkeypatch.setattr(episodes, "_CACHED", 2)
    sampler = GreenhouseEnv(bank=bank).simulation.sampler
    first, second, third = [bank.scene(name) for name in bank.names()[:3]]
    for scene in (first, second, first, third):
        sampler.fitting(scene, ("easy",))
    assert [key[0] for key in sampler._cache] == [id(first), id(third)]


def test_a_split_of_large_worlds_needs_a_window_sooner(small: None) -> None:
    assert SceneWindow(names(5)).whole
    assert not SceneWindow(names(5), largest=4).whole
