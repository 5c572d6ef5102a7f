"""Commands that train policies: train, sweep."""

from __future__ import annotations

from collections.abc import Callable
from math import prod
from pathlib import Path
from time import monotonic
from typing import Annotated, Any

import typer

from greenhouse_gym.cli.options import Address, Assignments, Backend, Bank, SettingsFile, Workers, executor_of
from greenhouse_gym.common.progress import say

ALGORITHMS = ("ppo", "bc-then-ppo", "sac-her")
"""Algorithms of the command ``train``."""

_SECONDS_BETWEEN_LINES = 20.0


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
    steps: Annotated[int, typer.Option(min=1, help="Environment steps.")] = 2_000_000,
    scene: Annotated[
        str | None, typer.Option(help="The only scene to train on; all of the split by default.", show_default=False)
    ] = None,
    target: Annotated[
        int | None, typer.Option(help="The only tomato of --scene to train on.", show_default=False)
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of scenes, weights and noise.")] = 0,
    backend: Annotated[
        str, typer.Option(help="mujoco; warp: ppo with simulations and networks on --device.")
    ] = "mujoco",
    device: Annotated[str, typer.Option(help="With --backend warp: cpu or cuda.")] = "cpu",
    resume: Annotated[bool, typer.Option(help="Resume from the checkpoint in the folder of results.")] = False,
    settings: SettingsFile = None,
    assignments: Assignments = None,
    print_settings: Annotated[
        bool, typer.Option("--print-settings", help="Print all settings of the algorithm, and exit.")
    ] = False,
) -> None:
    """Train a policy. Settings from a file and from --set override --bank, --steps, --scene, --target and --seed.

    Observation, action, reward and task may be your own, as --set reward=file.py:name or --set reward=module:name.
    """
    from greenhouse_gym.common.files import write_atomically
    from greenhouse_gym.common.settings_files import as_toml, resolve
    from greenhouse_gym.envs.factory import BACKENDS
    from greenhouse_gym.errors import InvalidValueError, require_choice

    if require_choice("backend", backend, BACKENDS) == "warp":
        if algorithm != "ppo" or resume:
            raise InvalidValueError("--backend warp trains by ppo, and resumes nothing")
        defaults, run = _on_device(device, bank, steps, seed, scene, target)
    else:
        defaults, run = _algorithm(require_choice("algorithm", algorithm, ALGORITHMS), bank, steps, seed, scene, target)
    resolved = resolve(defaults, settings, assignments or ())
    if print_settings:
        typer.echo(as_toml(resolved, comments=True), nl=False)
        return
    folder = Path("runs") / algorithm if out is None else out
    result = run(resolved, folder, **({"resume": True} if resume else {}))
    write_atomically(folder / "settings.toml", as_toml(resolved))
    say(f"policy in {result}")


def _algorithm(
    name: str, bank: str, steps: int, seed: int, scene: str | None, target: int | None
) -> tuple[Any, Callable[..., Path]]:
    """Return the default settings of an algorithm, and its training."""
    from dataclasses import replace
    from functools import partial

    from greenhouse_gym import learning

    common: dict[str, Any] = {
        "bank": bank, "total_steps": steps, "seed": seed, "scene": scene, "target": target
    }  # fmt: skip
    if name == "sac-her":
        return learning.SacSettings(**common), learning.train_sac
    if name == "ppo":
        return learning.PpoSettings(**common), learning.train_ppo
    settings = learning.BcThenPpoSettings()
    settings = replace(settings, ppo=replace(settings.ppo, **common))
    return settings, partial(learning.train_bc_then_ppo, on_progress=_print_imitation)


def _on_device(device: str, bank: str, steps: int, seed: int, scene: str | None, target: int | None) -> tuple[Any, Any]:
    """Return the default settings of PPO on a device, and its training."""
    from greenhouse_gym import learning

    settings = learning.DevicePpoSettings(
        bank=bank, total_steps=steps, seed=seed, scene=scene, target=target, device=device
    )
    return settings, learning.train_ppo_on_device


def _print_imitation(steps: int, metrics: dict[str, float]) -> None:
    say(f"{steps:,} steps of imitation: {', '.join(f'{name} {value:.3g}' for name, value in metrics.items())}")


def sweep(
    tries: Annotated[
        list[str],
        typer.Option("--try", help="A value to try, such as learning_rate=1e-4; give several for each setting."),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the sweep; on a cluster, one that all nodes share.")] = Path(
        "runs/sweep"
    ),
    bank: Bank = "default",
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
    """Train by PPO with every combination of the values to try; resumes an interrupted sweep.

    Each training has its own folder, as `train` leaves it; sweep.json lists all finished trainings, the best first.
    With ray the trainings are trials of Ray Tune, whose own files are in the folder tune.
    """
    from greenhouse_gym.common.settings_files import assigned, resolve
    from greenhouse_gym.learning import PpoSettings, sweep_ppo

    shared = resolve(PpoSettings(bank=bank, total_steps=steps), settings, assignments or ())
    choices: dict[str, list[Any]] = {}
    for text in tries:
        for name, value in assigned(text).items():
            choices.setdefault(name, []).append(value)

    def on_result(row: dict[str, Any], done: int, total: int) -> None:
        say(f"{done} of {total}: {row['folder']}: {row.get('error') or _summary(row)}")

    last = monotonic()

    def on_progress(row: dict[str, Any]) -> None:
        nonlocal last
        if monotonic() - last > _SECONDS_BETWEEN_LINES:
            last = monotonic()
            say(f"{row['folder']}: {_summary(row)}")

    with executor_of(backend, workers, address, prod(map(len, choices.values()))) as executor:
        rows = sweep_ppo(shared, choices, out, executor, on_result, stop_early=stop_early, on_progress=on_progress)
    say(f"table in {out / 'sweep.json'}; the best: {rows[0]['folder']}")


def _summary(row: dict[str, Any]) -> str:
    if "steps" not in row:
        return "no steps to train"
    rate = row.get("success_rate")
    success = "no episode ended" if rate is None else f"success {rate:.0%} in training"
    return f"{row['steps']:,.0f} steps, {success}{', stopped early' if row.get('stopped_early') else ''}"
