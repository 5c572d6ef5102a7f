"""The banks that ship with the package: which rows they are made of, and the one function that builds them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from greenhouse_gym.build import build_bank
from greenhouse_gym.capture import simulate_recording
from greenhouse_gym.cutting import BuildSettings
from greenhouse_gym.plants import grow_row
from greenhouse_gym.scene import SceneBank
from greenhouse_gym.scene.bank import write_bank

ROW_LENGTH = 2.0  # m
ROWS = tuple((seed, week) for week, seed in enumerate(range(100, 112)))
"""Seed of each row and its growth week, weeks counted modulo 4."""

SPLITS = ("train",) * 8 + ("validation",) * 2 + ("test",) * 2

DESCRIPTION = "Simulated recordings of grown cluster-tomato rows, reconstructed; seeds of the rows in their names."


def build_shipped_banks(out: Path) -> tuple[SceneBank, SceneBank]:
    """Build ``default`` (every row) and ``mini`` (four scenes of it) below a folder.

    An interrupted build goes on where it stopped.
    """
    recordings = [
        replace(simulate_recording(grow_row(seed, ROW_LENGTH, week % 4), seed), name=f"row-{seed}")
        for seed, week in ROWS
    ]
    weeks = [week % 4 for _, week in ROWS]
    default = build_bank(recordings, out / "default", "default", SPLITS, weeks, BuildSettings(), DESCRIPTION)
    chosen = [*default.names("train")[:2], default.names("validation")[0], default.names("test")[0]]
    mini = write_bank(
        out / "mini",
        [(default.scene(name), default.split_of(name)) for name in chosen],
        name="mini",
        description="Four scenes of the default bank, for tests.",
    )
    return default, mini
