from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("minari")

import minari

from greenhouse_gym.agents import RandomAgent
from greenhouse_gym.agents.demonstrations import record_demonstrations
from greenhouse_gym.envs import GreenhouseEnv
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.scene import SceneBank


def test_minari_reads_what_was_played(bank: SceneBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = record_demonstrations(RandomAgent(), tmp_path, 2, seed=7, successes_only=False, bank=bank)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    data = minari.load_dataset(name)
    assert data.total_episodes == 2
    env = GreenhouseEnv(bank=bank)
    for k, episode in enumerate(data.iterate_episodes()):
        observation, _ = env.reset(seed=7 + k)
        np.testing.assert_array_equal(episode.observations[0], observation)
        rewards = [env.step(action)[1] for action in episode.actions]
        np.testing.assert_allclose(episode.rewards, rewards)
        assert len(episode.infos["distance"]) == len(episode.actions) + 1
    env.close()


@pytest.mark.parametrize("observation", ["goal", "depth"])
def test_observations_in_parts_are_kept_part_by_part(
    bank: SceneBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, observation: str
) -> None:
    options: dict[str, Any] = {"bank": bank, "observation": observation}
    name = record_demonstrations(RandomAgent(), tmp_path, 1, seed=3, successes_only=False, step_limit=3, **options)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    episode = minari.load_dataset(name)[0]
    env = GreenhouseEnv(step_limit=3, **options)
    seen = [env.reset(seed=3)[0], *(env.step(action)[0] for action in episode.actions)]
    env.close()
    assert isinstance(seen[0], dict)
    assert set(episode.observations) == set(seen[0])
    for part, kept in episode.observations.items():
        np.testing.assert_array_equal(kept, [each[part] for each in seen])


def test_nothing_to_keep_and_the_test_split_are_told(bank: SceneBank, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="nothing to record"):
        record_demonstrations(RandomAgent(), tmp_path, 1, bank=bank, step_limit=1)
    with pytest.raises(InvalidValueError, match="test"):
        record_demonstrations(RandomAgent(), tmp_path, 1, split="test", bank=bank)
