"""All commands in one application; an expected error becomes one line and exit status 1."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable

import typer
from rich.console import Console
from rich.markup import escape

from greenhouse_gym.cli import (
    agent_commands,
    bank_commands,
    cloud_commands,
    live_recording,
    planning_commands,
    reconstruction_commands,
    recording_commands,
    training_commands,
)
from greenhouse_gym.cli.demo import demo
from greenhouse_gym.cli.doctor import doctor
from greenhouse_gym.errors import GreenhouseError

app = typer.Typer(
    help="Reinforcement learning and motion planning in reconstructed tomato greenhouses.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
_COMMANDS: dict[str, Callable[..., None]] = {
    "simulate": recording_commands.simulate,
    "reconstruct": reconstruction_commands.reconstruct,
    "build": reconstruction_commands.build,
    "import": recording_commands.import_,
    "calibrate": recording_commands.calibrate,
    "record": live_recording.record,
    "shapes": cloud_commands.shapes,
    "formats": recording_commands.formats,
    "build-shipped": reconstruction_commands.build_shipped,
    "plan": planning_commands.plan,
    "mount": planning_commands.mount,
    "rate": planning_commands.rate,
    "train": training_commands.train,
    "sweep": training_commands.sweep,
    "compare": agent_commands.compare,
    "submit": agent_commands.submit,
    "leaderboard": agent_commands.leaderboard,
    "demonstrations": agent_commands.demonstrations,
    "watch": agent_commands.watch,
    "render": planning_commands.render,
    "demo": demo,
    "doctor": doctor,
}
for name, command in _COMMANDS.items():
    app.command(name)(command)
app.add_typer(bank_commands.app, name="bank")
app.add_typer(agent_commands.policy_app, name="policy")


def main() -> None:
    """Run the command line."""
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"
    try:
        app()
    except GreenhouseError as error:
        Console(stderr=True).print(f"[bold red]error:[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(1)
