"""Commands that train policies: train, sweep."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, prod
from pathlib import Path
from time import monotonic
from typing import Annotated, Any

import typer

from greenhouse_gym.cli.options import (
    SETTINGS,
    Address,
    Backend,
    Bank,
    OneScene,
    OneTarget,
    SettingsFile,
    Workers,
    executor_of,
    given,
    set_option,
)
from greenhouse_gym.common.progress import progress, report, say

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
    seed: Annotated[int, typer.Option(help="Seed of scenes, weights and noise.")] = 0,
    backend: Annotated[
        str, typer.Option(help="mujoco; warp: ppo with simulations and networks on --device.")
    ] = "mujoco",
    device: Annotated[str, typer.Option(help="With --backend warp: cpu or cuda.")] = "cpu",
    scene: OneScene = None,
    target: OneTarget = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Resume from the checkpoint in the folder of results.")
    ] = False,
    settings: SettingsFile = None,
    assignments: Annotated[list[str] | None, set_option("learning_rate=1e-4")] = None,
    print_settings: Annotated[
        bool,
        typer.Option(
            "--print-settings", help="Print all settings of the algorithm, and exit.", rich_help_panel=SETTINGS
        ),
    ] = False,
) -> None:
    """Train a policy. Settings from a file and from --set override --bank, --steps, --scene, --target and --seed.

    Observation, action, reward and task may be your own, as --set reward=file.py:name or --set reward=module:name.
    """
    from greenhouse_gym.common.extras import require_extras
    from greenhouse_gym.common.files import write_atomically
    from greenhouse_gym.common.settings_files import as_toml, resolve
    from greenhouse_gym.envs.factory import BACKENDS
    from greenhouse_gym.errors import InvalidValueError, require_choice
    from greenhouse_gym.learning.settings import DevicePpoSettings

    if require_choice("backend", backend, BACKENDS) == "warp" and (algorithm != "ppo" or resume):
        raise InvalidValueError("--backend warp trains by ppo, and resumes nothing")
    require_extras("train")
    common = {"bank": bank, "total_steps": steps, "seed": seed, **given(scene=scene, target=target)}
    if backend == "warp":
        defaults: Any = DevicePpoSettings(device=device, **common)
    else:
        defaults = _defaults(require_choice("algorithm", algorithm, ALGORITHMS), common)
    resolved = resolve(defaults, settings, assignments or ())
    if print_settings:
        typer.echo(as_toml(resolved, comments=True), nl=False)
        return
    folder = Path("runs") / algorithm if out is None else out
    with progress("loading PyTorch"):
        run = _training(algorithm, backend)
    result = run(resolved, folder, **({"resume": True} if resume else {}))
    write_atomically(folder / "settings.toml", as_toml(resolved))
    say(f"policy in {result}")


def _defaults(algorithm: str, common: dict[str, Any]) -> Any:
    """Return the default settings of an algorithm, with some settings that all have."""
    from dataclasses import replace

    from greenhouse_gym.learning.settings import BcThenPpoSettings, PpoSettings, SacSettings

    if algorithm == "bc-then-ppo":
        settings = BcThenPpoSettings()
        return replace(settings, ppo=replace(settings.ppo, **common))
    return SacSettings(**common) if algorithm == "sac-her" else PpoSettings(**common)


def _training(algorithm: str, backend: str) -> Callable[..., Path]:
    from functools import partial

    from greenhouse_gym import learning

    if backend == "warp":
        return learning.train_ppo_on_device
    if algorithm == "bc-then-ppo":
        return partial(learning.train_bc_then_ppo, on_progress=_print_imitation)
    return learning.train_sac if algorithm == "sac-her" else learning.train_ppo


def _print_imitation(steps: int, metrics: dict[str, float]) -> None:
    report(f"{steps:,} steps of imitation: {', '.join(f'{name} {value:.3g}' for name, value in metrics.items())}")


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
    assignments: Annotated[list[str] | None, set_option("num_envs=64")] = None,
    backend: Backend = None,
    workers: Workers = None,
    address: Address = "local",
) -> None:
    """Train by PPO with every combination of the values to try; resumes an interrupted sweep.

    Each training has its own folder, as `train` leaves it; sweep.json lists all finished trainings, the best first.
    With ray the trainings are trials of Ray Tune, whose own files are in the folder tune.
    """
    from greenhouse_gym.common.extras import require_extras
    from greenhouse_gym.common.settings_files import assigned, resolve
    from greenhouse_gym.learning.settings import PpoSettings

    require_extras("train")
    shared = resolve(PpoSettings(bank=bank, total_steps=steps), settings, assignments or ())
    choices: dict[str, list[Any]] = {}
    for text in tries:
        resolve(shared, None, [text])  # raises before PyTorch is imported
        for name, value in assigned(text).items():
            choices.setdefault(name, []).append(value)

    from greenhouse_gym.learning import sweep_ppo

    def on_result(row: dict[str, Any], done: int, total: int) -> None:
        on_done(done)
        say(f"{done} of {total}: {row['folder']}: {row.get('error') or _summary(row)}")

    last = -inf

    def on_progress(row: dict[str, Any]) -> None:
        nonlocal last
        if monotonic() - last > _SECONDS_BETWEEN_LINES:
            last = monotonic()
            report(f"{row['folder']}: {_summary(row)}")

    trainings = prod(map(len, choices.values()))
    with executor_of(backend, workers, address, trainings) as executor, progress("trainings", trainings) as on_done:
        rows = sweep_ppo(shared, choices, out, executor, on_result, stop_early=stop_early, on_progress=on_progress)
    say(f"table in {out / 'sweep.json'}; the best: {rows[0]['folder']}")


def _summary(row: dict[str, Any]) -> str:
    if "steps" not in row:
        return "no steps to train"
    rate = row.get("success_rate")
    success = "no episode ended" if rate is None else f"success {rate:.0%} in training"
    return f"{row['steps']:,.0f} steps, {success}{', stopped early' if row.get('stopped_early') else ''}"
