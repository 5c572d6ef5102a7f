"""Trainings that diverge, run into a full disk, or share a folder lose nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("stable_baselines3")

import safetensors.torch
import torch

from greenhouse_gym.common.files import exclusive
from greenhouse_gym.errors import DivergedError, FileWriteError
from greenhouse_gym.learning import PpoSettings, train_ppo
from greenhouse_gym.learning.training_files import CHECKPOINT, read_curve, read_notes
from greenhouse_gym.scene import SceneBank


@pytest.fixture
def settings(bank: SceneBank) -> PpoSettings:
    return PpoSettings(
        bank=str(bank.path), observation="state", reward="dense", total_steps=64, num_envs=2, rollout_steps=8,
        batch_size=16, epochs=1, hidden=(8,), restart_steps=8, threads=1,
    )  # fmt: skip


@pytest.mark.parametrize("weight", [float("nan"), float("inf"), 1e30], ids=str)
def test_a_diverged_training_keeps_its_last_checkpoint(settings: PpoSettings, tmp_path: Path, weight: float) -> None:
    models: list[Any] = []

    def spoil(line: Any) -> None:
        if line["steps"] == 32:
            with torch.no_grad():
                models[0].policy.action_net.weight.fill_(weight)

    with pytest.raises(DivergedError, match="16 steps is kept"):
        train_ppo(settings, tmp_path, checkpoint_seconds=0, prepare=models.append, on_progress=spoil)
    assert read_notes(tmp_path)["steps"] == 16
    assert not (tmp_path / "policy.json").exists()
    path = train_ppo(settings, tmp_path, resume=True)
    assert path.name == "policy.json"
    assert [int(row["steps"]) for row in read_curve(tmp_path / "curve.csv")] == [16, 32, 48, 64]


def test_a_training_that_diverges_at_once_says_that_nothing_is_kept(settings: PpoSettings, tmp_path: Path) -> None:
    def spoil(model: Any) -> None:
        model.policy.log_std.data.fill_(200.0)

    with pytest.raises(DivergedError, match="no checkpoint"):
        train_ppo(settings, tmp_path / "run", prepare=spoil)
    assert train_ppo(settings, tmp_path / "run").is_file()


def test_a_second_training_in_a_folder_is_refused(settings: PpoSettings, tmp_path: Path) -> None:
    refused: list[str] = []

    def begin_another(line: Any) -> None:
        for resume in (False, True):
            try:
                train_ppo(settings, tmp_path, resume=resume)
            except Exception as error:
                refused.append(str(error))

    train_ppo(settings, tmp_path, on_progress=begin_another)
    assert refused
    assert all(text.startswith(str(tmp_path)) or "nothing to resume" in text for text in refused)
    assert any(f"at work in this folder: process {os.getpid()}" in text for text in refused)
    assert not (tmp_path / ".lock").exists()
    assert read_notes(tmp_path)["steps"] == 64


def test_the_lock_of_a_killed_process_is_no_hindrance(tmp_path: Path) -> None:
    code = (
        "import os, signal; from greenhouse_gym.common.files import exclusive\n"
        f"with exclusive({str(tmp_path)!r}): os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code], check=False)
    assert (tmp_path / ".lock").read_text()
    with exclusive(tmp_path), pytest.raises(FileWriteError, match=f"process {os.getpid()}"), exclusive(tmp_path):
        pass


def test_a_training_that_is_killed_and_resumed_ends_in_the_same_policy(settings: PpoSettings, tmp_path: Path) -> None:
    """Episodes end, the critic is trained alone, and the third kill is after the last step."""
    longer = replace(settings, total_steps=2048, rollout_steps=64, batch_size=64, restart_steps=256, critic_rollouts=6)

    def run(out: Path, resume: bool = False, killed_at: int | None = None) -> None:
        def kill(line: Mapping[str, float]) -> None:
            if line["steps"] == killed_at:
                raise SystemExit  # nothing is saved

        with pytest.raises(SystemExit) if killed_at else nullcontext():
            train_ppo(longer, out, resume=resume, checkpoint_seconds=0, on_progress=kill)

    run(tmp_path / "whole")
    for moment, resume in ((640, False), (1536, True), (2048, True), (None, True)):
        run(tmp_path / "killed", resume, moment)
    rows = [read_curve(tmp_path / name / "curve.csv") for name in ("whole", "killed")]
    told = [str([{**row, "seconds": 0} for row in curve]) for curve in rows]  # in which nan equals nan
    assert told[0] == told[1]
    assert sum(row["length"] > 0 for row in rows[0]) > 5
    whole, killed = (safetensors.torch.load_file(tmp_path / name / CHECKPOINT) for name in ("whole", "killed"))
    assert whole.keys() == killed.keys()
    assert all(torch.equal(whole[name], killed[name]) for name in whole)


@pytest.mark.slow
def test_a_full_disk_leaves_the_last_checkpoint(settings: PpoSettings, tmp_path: Path) -> None:
    pytest.importorskip("resource")
    code = f"""
import resource, signal
from greenhouse_gym.errors import FileWriteError
from greenhouse_gym.learning import PpoSettings, train_ppo
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
def fill(line):
    if line["steps"] == 32: resource.setrlimit(resource.RLIMIT_FSIZE, (8, 8))
try:
    train_ppo({settings!r}, {str(tmp_path)!r}, checkpoint_seconds=0, on_progress=fill)
except FileWriteError as error:
    print("told", error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "told" in done.stdout, done.stderr
    assert read_notes(tmp_path)["steps"] == 16
    assert not list(tmp_path.glob(f".{CHECKPOINT}.*"))
    assert train_ppo(settings, tmp_path, resume=True).is_file()
