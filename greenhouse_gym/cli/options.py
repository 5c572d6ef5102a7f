"""Options shared by several commands, and the objects that they select."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from greenhouse_gym.agents import Agent
    from greenhouse_gym.scene import Scene, SceneBank

Address = Annotated[str, typer.Option(help="With ray: local, auto, or HOST:PORT of a cluster's head.")]
Assignments = Annotated[
    list[str] | None,
    typer.Option("--set", help="A setting such as voxel=0.004; may be given several times.", show_default=False),
]
Backend = Annotated[
    str | None,
    typer.Option(help="Where the work runs: serial, processes or ray; the results are the same.", show_default=False),
]
Bank = Annotated[str, typer.Option(help="Name of a shipped bank, or folder of a bank.")]
BankArgument = Annotated[str, typer.Argument(help="Name of a shipped bank, or folder of a bank.")]
Format = Annotated[str | None, typer.Option("--format", help="Format of the recording; detected by default.")]
Out = Annotated[Path, typer.Option("--out", help="Folder for the results.")]
RigFile = Annotated[
    Path | None, typer.Option("--rig", help="Rig file, written by calibrate, with the poses of the cameras.")
]
Robot = Annotated[str, typer.Option(help="Name or file of the arm.")]
AgentRobot = Annotated[str, typer.Option(help="Name or file of the arm; by default the arm that each agent needs.")]
SceneName = Annotated[str, typer.Option("--scene", help="Name of the scene in the bank; the first one by default.")]
SettingsFile = Annotated[Path | None, typer.Option("--settings", help="TOML or JSON file of settings.")]
Workers = Annotated[
    int | None, typer.Option(min=1, help="Processes on this machine; one per core by default.", show_default=False)
]


def print_settings(settings: str) -> Any:
    """Return the option that prints all settings with defaults and comments, as a file to start from.

    Args:
        settings: Module and name of the settings' class, such as "package.module:Settings".
    """

    def show(wanted: bool) -> None:
        if wanted:
            from greenhouse_gym.common.settings_files import as_toml

            typer.echo(as_toml(resolve_name(settings)(), comments=True), nl=False)
            raise typer.Exit

    return typer.Option(
        "--print-settings", is_eager=True, callback=show, help="Print all settings with their defaults, and exit."
    )


def executor_of(
    backend: str | None, workers: int | None, address: str, tasks: int = 1
) -> AbstractContextManager[Executor | None]:
    """Return the executor that a command's options choose.

    Without a backend, processes run the work if their number is given, or if there are several tasks and idle cores;
    a Ray cluster runs it if its address is given.
    """
    from greenhouse_gym.common.executors import executor_for, idle_cores

    if backend is None:
        many = workers is not None or (tasks > 1 and idle_cores() > 1)
        backend = "ray" if address != "local" else "processes" if many else "serial"
    return executor_for(backend, workers, address)


def scene_in(bank: SceneBank, name: str) -> Scene:
    """Return the scene of a name, or the first scene if the name is empty."""
    return bank.scene(name) if name else bank[0]


def robot_for(agent: Agent, robot: str) -> dict[str, str]:
    """Return the environment's keyword for an arm, or nothing if no arm is given.

    Raises:
        InvalidValueError: The agent needs another arm.
    """
    from greenhouse_gym.errors import InvalidValueError

    needed = agent.env_options.get("robot", robot)
    if robot and needed != robot:
        raise InvalidValueError(f"agent {agent.name!r} needs robot={needed!r}, got {robot!r}")
    return {"robot": robot} if robot else {}


def comma_separated(text: str) -> tuple[str, ...]:
    """Split a list of names at its commas."""
    return tuple(part.strip() for part in text.split(",") if part.strip())
