"""The command that trains with several settings."""

from __future__ import annotations

from pathlib import Path
from time import monotonic
from typing import Annotated, Any

import typer

from greenhouse_gym.cli.settings import Assignments, SettingsFile
from greenhouse_gym.cli.spread import Address, Backend, Workers, spread
from greenhouse_gym.common.progress import say

_SECONDS_BETWEEN_LINES = 20.0


def sweep(
    tries: Annotated[
        list[str],
        typer.Option("--try", help="A value to try, such as learning_rate=1e-4; several of one setting take turns."),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the sweep; on a cluster, one that all nodes see.")] = Path(
        "runs/sweep"
    ),
    bank: Annotated[str, typer.Option(help="A shipped bank's name or a bank's folder.")] = "default",
    steps: Annotated[int, typer.Option(help="Environment steps of each training.")] = 2_000_000,
    stop_early: Annotated[
        bool, typer.Option("--stop-early", help="With ray: stop trainings that fall behind the median of the others.")
    ] = False,
    settings: SettingsFile = None,
    assignments: Assignments = None,
    backend: Backend = None,
    workers: Workers = None,
    address: Address = "local",
) -> None:
    """Train by PPO with every combination of the values to try; the same command goes on where it stopped.

    Each training has a folder of its own, as `train` leaves it; sweep.json lists all that are done, the best first.
    With ray the trainings are trials of Ray Tune, whose own files are in the folder tune.
    """
    from greenhouse_gym.common.settings_files import assigned, resolve
    from greenhouse_gym.learning import PpoSettings, sweep_ppo

    shared = resolve(PpoSettings(bank=bank, total_steps=steps), settings, assignments or ())
    choices: dict[str, list[Any]] = {}
    for text in tries:
        for name, value in assigned(text).items():
            choices.setdefault(name, []).append(value)
    pieces = 1
    for values in choices.values():
        pieces *= len(values)

    def tell(row: dict[str, Any], done: int, of: int) -> None:
        say(f"{done} of {of}: {row['folder']}: {row.get('error') or _summary(row)}")

    spoke = monotonic()

    def tell_line(row: dict[str, Any]) -> None:
        nonlocal spoke
        if monotonic() - spoke > _SECONDS_BETWEEN_LINES:
            spoke = monotonic()
            say(f"{row['folder']}: {_summary(row)}")

    with spread(backend, workers, address, pieces) as executor:
        rows = sweep_ppo(shared, choices, out, executor, tell, stop_early=stop_early, on_line=tell_line)
    say(f"table in {out / 'sweep.json'}; the best: {rows[0]['folder']}")


def _summary(row: dict[str, Any]) -> str:
    if "steps" not in row:
        return "no steps to train"
    rate = row.get("success_rate")
    told = f"{row['steps']:,.0f} steps, " + ("no episode ended" if rate is None else f"success {rate:.0%} in training")
    return told + (", stopped early" if row.get("stopped_early") else "")
