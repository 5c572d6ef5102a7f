"""All commands in one application; an expected error becomes one line and exit status 1."""

from __future__ import annotations

import sys
import warnings

import typer
from rich.console import Console
from rich.markup import escape

from greenhouse_gym.cli import (
    acting,
    arms,
    bank,
    comparing,
    demo,
    importing,
    policy,
    recording,
    scans,
    sensing,
    sweeping,
    training,
)
from greenhouse_gym.cli.doctor import doctor
from greenhouse_gym.errors import GreenhouseError

app = typer.Typer(
    help="Reinforcement learning and motion planning in reconstructed tomato greenhouses.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command()(sensing.simulate)
app.command()(sensing.reconstruct)
app.command()(sensing.build)
app.command("import")(importing.import_)
app.command()(importing.calibrate)
app.command()(recording.record)
app.command()(scans.shapes)
app.command()(sensing.formats)
app.command("build-shipped")(sensing.build_shipped)
app.command()(acting.plan)
app.command()(arms.mount)
app.command()(arms.rate)
app.command()(training.train)
app.command()(sweeping.sweep)
app.command()(comparing.compare)
app.command()(comparing.submit)
app.command()(comparing.leaderboard)
app.command()(comparing.demonstrations)
app.command()(comparing.watch)
app.command()(acting.render)
app.command()(demo.demo)
app.command()(doctor)
app.add_typer(bank.app, name="bank")
app.add_typer(policy.app, name="policy")


def main() -> None:
    """Run the command line."""
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
    try:
        app()
    except GreenhouseError as error:
        Console(stderr=True).print(f"[bold red]error:[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(1)
