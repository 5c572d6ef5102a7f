"""The command ``train``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from greenhouse_gym.cli.acting import Bank
from greenhouse_gym.cli.settings import Assignments, SettingsFile
from greenhouse_gym.common.progress import say

ALGORITHMS = ("ppo", "bc-then-ppo", "sac-her")
"""Algorithms of the command."""


def train(
    algorithm: Annotated[
        str,
        typer.Argument(
            help="ppo; bc-then-ppo: imitation of the roadmap rule first; sac-her: SAC with hindsight replay."
        ),
    ] = "ppo",
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results; runs/ALGORITHM by default.", show_default=False)
    ] = None,
    bank: Bank = "default",
    steps: Annotated[int, typer.Option(help="Environment steps of PPO and SAC.")] = 2_000_000,
    seed: Annotated[int, typer.Option(help="Seed of scenes, weights and noise.")] = 0,
    resume: Annotated[bool, typer.Option(help="Continue from the checkpoint in the folder of results.")] = False,
    settings: SettingsFile = None,
    assignments: Assignments = None,
    print_settings: Annotated[
        bool, typer.Option("--print-settings", help="Print all settings of the algorithm and exit.")
    ] = False,
) -> None:
    """Train a policy. Settings from a file and from --set replace --bank, --steps and --seed."""
    from greenhouse_gym.common.files import write_atomically
    from greenhouse_gym.common.settings_files import as_toml, resolve
    from greenhouse_gym.errors import require_choice

    defaults = _settings(require_choice("algorithm", algorithm, ALGORITHMS), bank, steps, seed)
    chosen = resolve(defaults, settings, assignments or ())
    if print_settings:
        typer.echo(as_toml(chosen, comments=True), nl=False)
        return
    folder = Path("runs") / algorithm if out is None else out
    policy = _train(chosen, folder, resume)
    write_atomically(folder / "settings.toml", as_toml(chosen))
    say(f"policy in {policy}")


def _settings(algorithm: str, bank: str, steps: int, seed: int) -> object:
    """Return the default settings of an algorithm."""
    from dataclasses import replace

    from greenhouse_gym.learning import BcThenPpoSettings, PpoSettings, SacSettings

    if algorithm == "sac-her":
        return SacSettings(bank=bank, total_steps=steps, seed=seed)
    if algorithm == "ppo":
        return PpoSettings(bank=bank, total_steps=steps, seed=seed)
    defaults = BcThenPpoSettings()
    return replace(defaults, ppo=replace(defaults.ppo, bank=bank, total_steps=steps, seed=seed))


def _train(settings: object, out: Path, resume: bool) -> Path:
    """Train with the algorithm of the settings and return the policy's file."""
    from greenhouse_gym.learning import (
        BcThenPpoSettings,
        PpoSettings,
        SacSettings,
        train_bc_then_ppo,
        train_ppo,
        train_sac,
    )

    match settings:
        case PpoSettings():
            return train_ppo(settings, out, resume=resume)
        case BcThenPpoSettings():
            return train_bc_then_ppo(settings, out, resume=resume, tell=_print_figures("steps"))
        case SacSettings():
            return train_sac(settings, out, resume=resume)
    raise TypeError(f"no settings of a training: {settings!r}")


def _print_figures(unit: str) -> Callable[[int, dict[str, float]], None]:
    def print_line(done: int, figures: dict[str, float]) -> None:
        listed = ", ".join(f"{name} {value:.3g}" for name, value in figures.items())
        say(f"{done:,} {unit} of imitation: {listed}")

    return print_line
