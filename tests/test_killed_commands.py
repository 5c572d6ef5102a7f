"""A command that is killed or meets a full disk, and is repeated, ends with the files of one that was left alone."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from killed import Commands, contents

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="commands are forked")

PPO = "--bank mini --set num_envs=4 --set rollout_steps=32 --set batch_size=64 --set hidden=[8] --set restart_steps=128"
BC = (
    "--steps 2048 --bank mini --set ppo.num_envs=4 --set ppo.rollout_steps=32 --set ppo.batch_size=64 "
    "--set ppo.hidden=[16,16] --set ppo.threads=1 --set ppo.restart_steps=64 "
    "--set imitation.steps=512 --set imitation.num_envs=4"
)
SAC = (
    "--bank mini --set num_envs=4 --set batch_size=32 --set hidden=[8] --set random_steps=800 --set threads=1 "
    "--set validation_steps=512 --set validation_episodes=2"
)
WARP = "--bank mini --set num_envs=16 --set rollout_steps=32 --set hidden=[8]"
COMMANDS: Mapping[str, str] = MappingProxyType(
    {
        "simulate": "simulate OUT --length 0.1",
        "import": "import RECORDING --out OUT",
        "reconstruct": "reconstruct RECORDING --out OUT --points 2000 --faces 1500",
        "shapes": "shapes CLOUD --out OUT",
        "build": "build RECORDING --out OUT --name b --set max_targets=3",
        "rate": "rate mini --robot iiwa14 --out OUT --per-scene 1",
        "compose": "bank compose mini --out OUT --scenes 3",
        "grow": "bank grow --rows 1 --source own --out OUT",
        "brush": "brush mini --out OUT",
        "train": f"train ppo --out OUT --steps 8192 {PPO}",
        "train-bc": f"train bc-then-ppo --out OUT {BC}",
        "train-sac": f"train sac-her --out OUT --steps 1024 {SAC}",
        "train-warp": f"train ppo --backend warp --out OUT --steps 8192 {WARP}",
        "sweep": f"sweep --out OUT --try seed=0 --try seed=1 --set total_steps=256 {PPO}",
        "demonstrations": "demonstrations roadmap --bank mini --out OUT --episodes 8",
        "submit": "submit random --out OUT --episodes 6 --track reconstruction",
        "compare": "compare random straight-line --bank mini --episodes 4 --report OUT/report.html",
        "watch": "watch straight-line --bank mini --out OUT/film.mp4",
    }
)
TIMED = (".html", ".png", "curve.csv", "validation.csv", ".hdf5", "events.out.tfevents")
"""Endings and parts of the names of files that hold times, or pictures of them."""


def arguments(name: str, folder: Path, out: Path) -> list[str]:
    places = {"OUT": out, "RECORDING": folder / "recording", "CLOUD": folder / "reconstruct" / "out" / "row.ply"}
    words = COMMANDS[name].split()
    return ["/".join(str(places.get(part, part)) for part in word.split("/")) for word in words]


class Whole:
    """Everything that an undisturbed command writes."""

    def __init__(self, commands: Commands, name: str, folder: Path):
        self.commands, self.name, self.folder = commands, name, folder
        out = folder / name / "out"  # a bank has its folder's name
        ended = commands.run(*arguments(name, folder, out))
        assert ended.status == 0, ended.printed
        self.seconds, self.files = ended.seconds, contents(out, TIMED)

    def assert_it_resumes(self, out: Path) -> None:
        words = arguments(self.name, self.folder, out)
        again = self.commands.run(*words)
        if self.name == "train-warp" and again.status:  # it resumes nothing, and overwrites nothing
            assert (out / "policy.json").is_file()
            return
        from_checkpoint = self.name.startswith("train") and again.status != 0  # which is never overwritten unasked
        if from_checkpoint:
            again = self.commands.run(*words, "--resume")
        assert again.status == 0, again.printed
        assert contents(out, TIMED).keys() == self.files.keys(), (
            self.name,
            contents(out, TIMED).keys() ^ self.files.keys(),
        )
        if self.name != "train-sac" or not from_checkpoint:  # whose replay buffer is empty again
            assert contents(out, TIMED) == self.files, self.name

    def kill(self, moment: float) -> None:
        out = self.folder / f"{self.name}-killed-{moment:.6f}" / "out"
        self.commands.run(*arguments(self.name, self.folder, out), killed_after=moment * self.seconds)
        if contents(out, TIMED) != self.files:  # else it had just ended
            self.assert_it_resumes(out)

    def fill_disk(self, room: int) -> None:
        out = self.folder / f"{self.name}-full-{room}" / "out"
        ended = self.commands.run(*arguments(self.name, self.folder, out), room=room)
        if ended.status:  # there may be fewer files
            assert ended.status == 1, ended.printed
            assert re.search(rf"error: {out}.*: cannot be written .*No space left", ended.printed.replace("\n", " "))
            assert not list(out.rglob("*.part"))
        self.assert_it_resumes(out)


def test_a_simulation_is_repeated(tmp_path: Path) -> None:
    with Commands(tmp_path, imported="") as commands:
        whole = Whole(commands, "simulate", tmp_path)
        whole.kill(0.6)
        whole.fill_disk(3)


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_every_command_killed_at_ten_moments_and_on_full_disks(tmp_path: Path) -> None:
    with Commands(tmp_path) as commands:
        assert commands.run("simulate", tmp_path / "recording", "--length", "0.2").status == 0
        for name in COMMANDS:
            whole = Whole(commands, name, tmp_path)
            for moment in np.random.default_rng(0).uniform(0.02, 0.95, 10):
                whole.kill(moment)
            for room in (0, 1, 3):
                whole.fill_disk(room)
