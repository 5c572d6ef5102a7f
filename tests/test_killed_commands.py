"""A command that is killed at any moment, and repeated, ends with the files of one that was left alone."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from killed import Commands, contents

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="commands are forked")

PPO = "--bank mini --set num_envs=4 --set rollout_steps=32 --set batch_size=64 --set hidden=[8]"
COMMANDS: Mapping[str, str] = MappingProxyType(
    {
        "simulate": "simulate OUT --length 0.2",
        "import": "import RECORDING --out OUT",
        "reconstruct": "reconstruct RECORDING --out OUT --points 2000 --faces 1500",
        "shapes": "shapes CLOUD --out OUT",
        "build": "build RECORDING --out OUT --name b --set max_targets=3",
        "rate": "rate mini --robot iiwa14 --out OUT",
        "train": f"train ppo --out OUT --steps 1024 {PPO}",
        "sweep": f"sweep --out OUT --try seed=0 --try seed=1 --set total_steps=256 {PPO}",
        "demonstrations": "demonstrations roadmap --bank mini --out OUT --episodes 8",
        "submit": "submit random --out OUT --episodes 6 --track reconstruction",
        "compare": "compare random straight-line --bank mini --episodes 4 --report OUT/report.html",
        "watch": "watch straight-line --bank mini --out OUT/film.mp4",
    }
)
TIMED = (".html", ".png", "curve.csv", ".hdf5", "events.out.tfevents")
"""Endings and parts of the names of files that hold times, or pictures of them."""


def arguments(name: str, folder: Path, out: Path) -> list[str]:
    places = {"OUT": out, "RECORDING": folder / "recording", "CLOUD": folder / "reconstruct" / "row.ply"}
    words = COMMANDS[name].split()
    return ["/".join(str(places.get(part, part)) for part in word.split("/")) for word in words]


def assert_it_resumes(commands: Commands, name: str, folder: Path, kills: int) -> None:
    whole = commands.run(*arguments(name, folder, folder / name))
    assert whole.status == 0, whole.printed
    expected = contents(folder / name, TIMED)
    rng = np.random.default_rng(0)
    for k, moment in enumerate(rng.uniform(0.02, 0.95, kills)):
        out = folder / f"{name}-{k}"
        commands.run(*arguments(name, folder, out), killed_after=moment * whole.seconds)
        again = commands.run(*arguments(name, folder, out))
        from_checkpoint = name == "train" and again.status != 0  # which is never overwritten unasked
        if from_checkpoint:
            again = commands.run(*arguments(name, folder, out), "--resume")
        assert again.status == 0, again.printed
        assert contents(out, TIMED).keys() == expected.keys(), (name, moment)
        if not from_checkpoint:
            assert contents(out, TIMED) == expected, (name, moment)


def test_a_killed_simulation_is_repeated(tmp_path: Path) -> None:
    with Commands(tmp_path, imported="") as commands:
        assert_it_resumes(commands, "simulate", tmp_path, 1)


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_every_command_killed_at_ten_moments(tmp_path: Path) -> None:
    with Commands(tmp_path) as commands:
        assert commands.run("simulate", tmp_path / "recording", "--length", "0.2").status == 0
        for name in COMMANDS:
            assert_it_resumes(commands, name, tmp_path, 10)
