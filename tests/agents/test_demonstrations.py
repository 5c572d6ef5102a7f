from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest

pytest.importorskip("minari")

import minari

from greenhouse_gym.agents import RandomAgent, demonstrations
from greenhouse_gym.agents.demonstrations import record_demonstrations
from greenhouse_gym.envs import DepthCamera, DepthObservation, GreenhouseEnv
from greenhouse_gym.errors import FileWriteError, InvalidValueError
from greenhouse_gym.scene import SceneBank


def test_minari_reads_what_was_played(bank: SceneBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = record_demonstrations(RandomAgent(), tmp_path, 2, seed=7, successes_only=False, bank=bank)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    data = minari.load_dataset(name)
    assert data.total_episodes == 2
    env = GreenhouseEnv(bank=bank, action="joint")
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
    env = GreenhouseEnv(step_limit=3, action="joint", **options)
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


def test_the_environment_is_recovered(bank: SceneBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = DepthObservation(camera=DepthCamera(width=8, height=6))
    name = record_demonstrations("random", tmp_path, 1, successes_only=False, bank=bank, observation=own, step_limit=2)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    data = minari.load_dataset(name)
    env = data.recover_environment()
    assert env.observation_space == data.observation_space
    assert env.unwrapped.settings.step_limit == 2


def test_a_data_set_grows_and_one_of_other_settings_is_refused_before_the_first_episode(
    bank: SceneBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demonstrations, "SAVE_SECONDS", 0.0)
    seen: list[int] = []

    def count(done: int) -> None:
        folder = tmp_path / "tomato-reach" / "random-v0" / "data"
        seen.append(done if (folder / "main_data.hdf5").is_file() else 0)

    options: dict[str, Any] = {"successes_only": False, "bank": bank, "step_limit": 2}
    name = record_demonstrations(RandomAgent(), tmp_path, 3, on_progress=count, **options)
    assert seen == [0, 2, 3]
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert [episode.id for episode in minari.load_dataset(name).iterate_episodes()] == [0, 1, 2]
    assert record_demonstrations(RandomAgent(), tmp_path, 3, on_progress=pytest.fail, **options) == name
    for changed in ({"seed": 1}, {"step_limit": 3}, {"successes_only": True}, {"split": "validation"}):
        with pytest.raises(InvalidValueError, match="of other settings"):
            record_demonstrations(RandomAgent(), tmp_path, 3, on_progress=pytest.fail, **{**options, **changed})


@pytest.mark.parametrize("at", [1, 2, 4], ids=["first episodes", "episodes", "after their number"])
def test_a_killed_recording_resumes_to_the_same_data_set(
    bank: SceneBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: int
) -> None:
    """The process ends between the file of the episodes and that of their number, too, and leaves its files behind."""
    options: dict[str, Any] = {"successes_only": False, "bank": bank, "step_limit": 2}
    name = record_demonstrations(RandomAgent(), tmp_path / "whole", 4, **options)
    monkeypatch.setattr(demonstrations, "SAVE_SECONDS", 0.0)
    moved: list[Path] = []

    class Killed(BaseException):
        pass

    def move(path: Path, target: Path) -> None:
        if len(moved) == at:
            raise Killed
        path.rename(target)
        moved.append(target)

    with monkeypatch.context() as patched:
        patched.setattr(demonstrations.tempfile, "TemporaryDirectory", lambda **given: nullcontext(mkdtemp(
            given["suffix"], given["prefix"], given["dir"])))  # fmt: skip
        patched.setattr(Path, "replace", move)
        with pytest.raises(Killed):
            record_demonstrations(RandomAgent(), tmp_path / "killed", 4, **options)
    record_demonstrations(RandomAgent(), tmp_path / "killed", 4, **options)
    columns = []
    for folder in ("whole", "killed"):
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / folder))
        data = minari.load_dataset(name)
        columns.append([(e.id, e.rewards.tolist(), e.actions.tolist()) for e in data.iterate_episodes()])
        assert (data.total_episodes, data.total_steps) == (4, sum(len(each[1]) for each in columns[-1]))
        assert {path.name for path in (tmp_path / folder / name).rglob("*")} == {
            "data", "main_data.hdf5", "metadata.json",
        }  # fmt: skip
    assert columns[0] == columns[1]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), RuntimeError("Can't flush")])
def test_what_was_written_before_the_disk_was_full_is_kept(
    bank: SceneBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    monkeypatch.setattr(demonstrations, "SAVE_SECONDS", 0.0)

    def fill(done: int) -> None:
        if done == 2:  # the first episode is written
            monkeypatch.setattr(minari.MinariDataset, "update_dataset_from_buffer", full)

    def full(*_: Any) -> None:
        raise error

    with pytest.raises(FileWriteError, match="keeps its first 1 episodes"):
        record_demonstrations(
            RandomAgent(), tmp_path, 5, successes_only=False, on_progress=fill, bank=bank, step_limit=2
        )
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert minari.load_dataset("tomato-reach/random-v0").total_episodes == 1
    assert {path.name for path in tmp_path.iterdir()} == {"tomato-reach"}


def test_an_interruption_keeps_the_episodes(bank: SceneBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(done: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record_demonstrations(
            RandomAgent(), tmp_path, 5, successes_only=False, on_progress=interrupt, bank=bank, step_limit=2
        )
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert minari.load_dataset("tomato-reach/random-v0").total_episodes == 2
