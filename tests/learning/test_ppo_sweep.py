from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("stable_baselines3")

from parallel_helpers import Elsewhere
from typer.testing import CliRunner

from greenhouse_gym.cli.main import app
from greenhouse_gym.common.executors import RayExecutor
from greenhouse_gym.common.files import exclusive
from greenhouse_gym.errors import FileWriteError, InvalidValueError, UnknownNameError
from greenhouse_gym.learning import PpoSettings, ppo_sweep, sweep_ppo
from greenhouse_gym.learning.training_files import CURVE, read_curve
from greenhouse_gym.scene import SceneBank


@pytest.fixture
def settings(bank: SceneBank) -> PpoSettings:
    return PpoSettings(
        bank=str(bank.path), observation="state", reward="dense", total_steps=64, num_envs=4, rollout_steps=8,
        batch_size=16, epochs=1, hidden=(8,),
    )  # fmt: skip


def test_every_combination_is_trained_elsewhere_and_goes_on_where_it_stopped(
    settings: PpoSettings, tmp_path: Path
) -> None:
    told: list[Any] = []
    choices = {"seed": [0, 1], "learning_rate": [1e-3]}
    rows = sweep_ppo(settings, choices, tmp_path, Elsewhere(), lambda *all_of: told.append(all_of[1:]))
    assert told == [(1, 2), (2, 2)]
    assert {row["folder"] for row in rows} == {"seed=0,learning_rate=0.001", "seed=1,learning_rate=0.001"}
    assert json.loads((tmp_path / ppo_sweep.TABLE).read_text()) == rows
    weights = [(tmp_path / row["folder"] / "policy.safetensors").read_bytes() for row in rows]
    assert weights[0] != weights[1]
    longer = PpoSettings(**{**vars(settings), "total_steps": 96})
    again = sweep_ppo(longer, choices, tmp_path)
    for row in again:
        assert [line["steps"] for line in read_curve(tmp_path / row["folder"] / CURVE)] == [32, 64, 96]
        assert json.loads((tmp_path / row["folder"] / "settings.json").read_text())["threads"] == 1


@pytest.mark.slow
@pytest.mark.xdist_group("ray")
def test_trials_of_ray_tune_give_the_table_of_one_process(
    settings: PpoSettings, tmp_path: Path, cluster: RayExecutor
) -> None:
    pytest.importorskip("ray.tune")
    told: list[ppo_sweep.Row] = []
    choices = {"observation": ["state", "depths"]}
    here = sweep_ppo(settings, choices, tmp_path / "here")
    there = sweep_ppo(settings, choices, tmp_path / "there", RayExecutor(cpus=2), on_progress=told.append)
    assert json.loads((tmp_path / "there" / ppo_sweep.TABLE).read_text()) == there
    for row in [*here, *there]:
        row.pop("seconds", None)
    assert there == here
    assert [(row["folder"], row["steps"]) for row in told] == [("observation=state", 32), ("observation=state", 64)]
    one, other = (tmp_path / place / "observation=state" / "policy.safetensors" for place in ("here", "there"))
    assert one.read_bytes() == other.read_bytes()


def test_trainings_are_stopped_early_by_ray_alone(settings: PpoSettings, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="stop_early needs a RayExecutor"):
        sweep_ppo(settings, {"seed": [0]}, tmp_path, Elsewhere(), stop_early=True)


def test_a_training_that_is_stopped_can_be_played_and_gone_on_with(settings: PpoSettings, tmp_path: Path) -> None:
    """A node that resumes a training reports all lines of its curve again."""
    (training,) = ppo_sweep._trainings(settings, {"seed": [0]}, tmp_path).values()
    told: list[tuple[float, float]] = []

    def stop(line: Mapping[str, float], row: ppo_sweep.Row) -> None:
        told.append((line["steps"], row["steps"]))
        if len(told) in (1, 4):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ppo_sweep._train(training, stop)
    assert (training.folder / "policy.safetensors").exists()
    assert ppo_sweep._train(training, stop)["steps"] == 64
    with pytest.raises(KeyboardInterrupt):
        ppo_sweep._train(training, stop)
    assert told == [(32, 32), (32, 32), (64, 64), (32, 64)]


def test_a_folder_that_a_node_does_not_see_is_named(settings: PpoSettings, tmp_path: Path) -> None:
    (training,) = ppo_sweep._trainings(settings, {"seed": [0]}, tmp_path / "gone").values()
    assert "all nodes must see it" in ppo_sweep._train(training)["error"]
    assert not (tmp_path / "gone").exists()


def test_a_training_that_fails_leaves_the_others_alone(settings: PpoSettings, tmp_path: Path) -> None:
    rows = sweep_ppo(settings, {"observation": ["depths", "state"]}, tmp_path)
    assert [row["observation"] for row in rows if "error" not in row] == ["state"]
    (failed,) = (row for row in rows if "error" in row)
    assert "unknown observation 'depths'" in failed["error"]


def test_a_training_that_diverges_leaves_the_others_alone(
    settings: PpoSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverging(settings: PpoSettings, folder: Path, **_: Any) -> None:
        if settings.seed == 0:
            raise ValueError("Expected parameter loc to satisfy the constraint Real(), but found nan")
        folder.mkdir()
        (folder / CURVE).write_text("steps,success_rate\n64,0.5\n")

    monkeypatch.setattr(ppo_sweep, "train_ppo", diverging)
    good, failed = sweep_ppo(settings, {"seed": [0, 1]}, tmp_path)
    assert (good["seed"], good["success_rate"]) == (1, 0.5)
    assert failed["error"].startswith("ValueError: Expected parameter loc")
    assert json.loads((tmp_path / ppo_sweep.TABLE).read_text()) == [good, failed]


def test_only_a_training_that_is_not_done_was_stopped_early(
    settings: PpoSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ray.tune")

    def trials(work: object, items: Mapping[str, Any], cluster: object, out: Path, ended: Any, *_: object) -> None:
        for name, steps in zip(items, (64.0, 32.0), strict=True):
            ended(name, {"folder": name, "steps": steps}, True)

    monkeypatch.setattr("greenhouse_gym.common.executors.ray_tune.run_trials", trials)
    rows: list[ppo_sweep.Row] = []
    trainings = ppo_sweep._trainings(settings, {"seed": [0, 1]}, tmp_path)
    ppo_sweep._tune(trainings, RayExecutor.__new__(RayExecutor), tmp_path, rows.append, rows.append, True)
    assert [row.get("stopped_early") for row in rows] == [None, True]


def test_invalid_choices_are_refused_before_any_training(settings: PpoSettings, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"unknown setting 'sed'. Did you mean 'seed'"):
        sweep_ppo(settings, {"sed": [0]}, tmp_path)
    with pytest.raises(InvalidValueError, match="setting learning_rate"):
        sweep_ppo(settings, {"learning_rate": ["fast"]}, tmp_path)
    with pytest.raises(InvalidValueError, match="tried twice"):
        sweep_ppo(settings, {"seed": [0, 0]}, tmp_path)
    with pytest.raises(InvalidValueError, match="values to try"):
        sweep_ppo(settings, {"seed": []}, tmp_path)
    with exclusive(tmp_path), pytest.raises(FileWriteError, match="another process"):
        sweep_ppo(settings, {"seed": [0]}, tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_command_tries_each_value_given(bank: SceneBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def trained(settings: PpoSettings, folder: Path, **_: Any) -> None:
        folder.mkdir()
        (folder / "curve.csv").write_text(f"steps,success_rate\n{settings.total_steps},0.{settings.seed}\n")

    monkeypatch.setattr(ppo_sweep, "train_ppo", trained)
    options = ["--try", "seed=1", "--try", "seed=2", "--try", "hidden=[8, 8]", "--steps", "7", "--backend", "serial"]
    result = CliRunner().invoke(app, ["sweep", "--out", str(tmp_path), "--bank", str(bank.path), *options])
    assert result.exit_code == 0, result.output
    rows = json.loads((tmp_path / ppo_sweep.TABLE).read_text())
    assert [(row["seed"], row["steps"], row["success_rate"]) for row in rows] == [(2, 7.0, 0.2), (1, 7.0, 0.1)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--try", "seed=0", "--steps", "-1"], "total_steps: Input should be greater than or equal to 0, got -1"),
        (["--try", "learning_rat=1e-4"], "Did you mean 'learning_rate'"),
        (["--try", "epochs=0"], "epochs"),
    ],
)
def test_a_sweep_checks_its_settings_first(bank: SceneBank, tmp_path: Path, arguments: list[str], message: str) -> None:
    asked = ["sweep", *arguments, "--bank", str(bank.path), "--backend", "serial", "--out", str(tmp_path)]
    assert message in str(CliRunner().invoke(app, asked).exception)
    assert not list(tmp_path.iterdir())
