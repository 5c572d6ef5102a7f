"""The command that trains policies."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from greenhouse_gym.cli.acting import Bank
from greenhouse_gym.cli.settings import Assignments, SettingsFile
from greenhouse_gym.cli.spread import Address
from greenhouse_gym.common.progress import say

if TYPE_CHECKING:
    from greenhouse_gym.learning.sac_report import SacProgress

ALGORITHMS = ("ppo", "bc-then-ppo", "depth", "sac-her")
"""What can be trained with."""


def train(
    algorithm: Annotated[
        str,
        typer.Argument(
            help="ppo; bc-then-ppo: imitation of a teacher first; depth: ways judged from images; sac-her: SAC with "
            "hindsight replay."
        ),
    ] = "ppo",
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results; runs/ALGORITHM by default.", show_default=False)
    ] = None,
    bank: Bank = "default",
    steps: Annotated[int, typer.Option(help="Environment steps of PPO and SAC; depth has none.")] = 2_000_000,
    seed: Annotated[int, typer.Option(help="Seed of scenes, weights and noise.")] = 0,
    resume: Annotated[bool, typer.Option(help="Go on from the checkpoint in the folder of results.")] = False,
    actors: Annotated[
        int, typer.Option(min=0, help="Processes of a Ray cluster that step PPO's simulations; with 0 this one does.")
    ] = 0,
    address: Address = "local",
    settings: SettingsFile = None,
    assignments: Assignments = None,
    print_settings: Annotated[
        bool, typer.Option("--print-settings", help="Print all settings of the algorithm, and do no more.")
    ] = False,
) -> None:
    """Train a policy. Settings from a file and from --set replace what --bank, --steps and --seed say."""
    from functools import partial

    from greenhouse_gym.common.files import write_atomically
    from greenhouse_gym.common.settings_files import as_toml, resolve
    from greenhouse_gym.errors import require_choice
    from greenhouse_gym.learning.sb3 import make_sb3_vec_env
    from greenhouse_gym.learning.sb3_ray import make_sb3_ray_vec_env

    usual = _settings(require_choice("algorithm", algorithm, ALGORITHMS), bank, steps, seed)
    wanted = resolve(usual, settings, assignments or ())
    if print_settings:
        typer.echo(as_toml(wanted, comments=True), nl=False)
        return
    make_env = partial(make_sb3_ray_vec_env, actors=actors, address=address) if actors else make_sb3_vec_env
    folder = Path("runs") / algorithm if out is None else out
    result = _trained(wanted, folder, resume, make_env)
    write_atomically(folder / "settings.toml", as_toml(wanted))
    say(f"{'checkpoint' if algorithm == 'sac-her' else 'policy'} in {result}")


def _settings(algorithm: str, bank: str, steps: int, seed: int) -> object:
    """The usual settings of an algorithm."""
    from dataclasses import replace

    from greenhouse_gym.learning import BcThenPpoSettings, DepthSettings, PpoSettings, SacSettings

    if algorithm == "depth":
        return DepthSettings(bank=bank, seed=seed)
    if algorithm == "sac-her":
        return SacSettings(bank=bank, total_steps=steps, seed=seed)
    if algorithm == "ppo":
        return PpoSettings(bank=bank, total_steps=steps, seed=seed)
    usual = BcThenPpoSettings()
    return replace(usual, ppo=replace(usual.ppo, bank=bank, total_steps=steps, seed=seed))


def _trained(settings: object, out: Path, resume: bool, make_env: Callable[..., Any]) -> Path:
    """Train as settings say: the file that holds what was learned."""
    from greenhouse_gym.learning import (
        BcThenPpoSettings,
        DepthSettings,
        PpoSettings,
        SacSettings,
        train_bc_then_ppo,
        train_depth,
        train_ppo,
        train_sac,
    )

    match settings:
        case PpoSettings():
            return train_ppo(settings, out, resume=resume, make_env=make_env)
        case BcThenPpoSettings():
            return train_bc_then_ppo(settings, out, resume=resume, tell=_told("steps"), make_env=make_env)
        case DepthSettings():
            return train_depth(settings, out, resume=resume, tell=_told("episodes"))
        case SacSettings():
            return train_sac(settings, out, resume=resume, tell=_judged)
    raise TypeError(f"no settings of a training: {settings!r}")


def _told(what: str) -> Callable[[int, dict[str, float]], None]:
    def tell(done: int, figures: dict[str, float]) -> None:
        told = ", ".join(f"{name} {value:.3g}" for name, value in figures.items())
        say(f"{done:,} {what} of imitation: {told}")

    return tell


def _judged(told: SacProgress) -> None:
    shares = ", ".join(
        f"{rows}: success {found.success_rate:.0%}, collision {found.collision_rate:.0%}"
        for rows, found in (("training rows", told.train), ("validation rows", told.validation))
    )
    say(f"{told.steps:,} steps, {told.seconds:.0f} s of processor time; {shares}")
