"""All commands in one application; an expected error becomes one line and exit status 1."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from greenhouse_gym import __version__
from greenhouse_gym.cli import (
    agent_commands,
    bank_commands,
    comparison_commands,
    planning_commands,
    reconstruction_commands,
    recording_commands,
    training_commands,
)
from greenhouse_gym.cli.demo import demo
from greenhouse_gym.cli.doctor import doctor, list_names
from greenhouse_gym.errors import GreenhouseError

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode="markdown")

_COMMANDS: dict[str, dict[str, Callable[..., None] | typer.Typer]] = {
    "Learning": {
        "train": training_commands.train,
        "sweep": training_commands.sweep,
        "compare": comparison_commands.compare,
        "watch": agent_commands.watch,
        "demonstrations": agent_commands.demonstrations,
        "submit": comparison_commands.submit,
        "leaderboard": comparison_commands.leaderboard,
    },
    "Planning": {
        "plan": planning_commands.plan,
        "render": planning_commands.render,
        "mount": planning_commands.mount,
    },
    "From recordings to scenes": {
        "simulate": recording_commands.simulate,
        "record": recording_commands.record,
        "import": recording_commands.import_,
        "formats": recording_commands.formats,
        "calibrate": recording_commands.calibrate,
        "reconstruct": reconstruction_commands.reconstruct,
        "shapes": reconstruction_commands.shapes,
        "build": reconstruction_commands.build,
    },
    "Banks and policies": {
        "bank": bank_commands.app,
        "rate": planning_commands.rate,
        "brush": planning_commands.brush,
        "policy": agent_commands.policy_app,
    },
    "Help": {
        "demo": demo,
        "doctor": doctor,
        "list": list_names,
    },
}
"""Commands and groups of commands by panel of the help."""

for panel, commands in _COMMANDS.items():
    for name, command in commands.items():
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name, rich_help_panel=panel)
        else:
            app.command(name, rich_help_panel=panel)(command)
app.command("build-shipped", hidden=True)(reconstruction_commands.build_shipped)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"greenhouse-gym {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version, and exit.")
    ] = False,
) -> None:
    """Reinforcement learning and motion planning in reconstructed tomato greenhouses."""


def main() -> None:
    """Run the command line."""
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
    try:
        app()
    except GreenhouseError as error:
        _fail(str(error))
    except MemoryError as error:
        _fail(f"there is not enough memory ({str(error) or type(error).__name__})")


def _fail(message: str) -> None:
    Console(stderr=True).print(f"[bold red]error:[/] {escape(message)}", highlight=False, soft_wrap=True)
    sys.exit(1)
