"""Options shared by several commands, and the objects that they select."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from greenhouse_gym.scene import Scene, SceneBank

PARALLEL, SETTINGS = "Parallel work", "Settings"
"""Panels of options in the help."""


def planner_names() -> list[str]:
    """Return the planners' names, to complete a word, without starting OMPL."""
    from greenhouse_gym.planning import PAPER_PLANNERS

    return list(PAPER_PLANNERS)


def _agent_names() -> list[str]:
    from greenhouse_gym.agents.named import SIMPLE
    from greenhouse_gym.agents.policy_agent import shipped_policies

    return [*SIMPLE, *shipped_policies(), *planner_names()]


def _bank_names() -> list[str]:
    from greenhouse_gym.scene.bank import shipped_banks

    return list(shipped_banks())


_AGENT = (
    "A name of `greenhouse-gym list`, a policy's file, a training's folder, or your own as file.py:Class or "
    "module:Class."
)

Address = Annotated[
    str, typer.Option(help="With ray: local, auto, or HOST:PORT of a cluster's head.", rich_help_panel=PARALLEL)
]
AgentArgument = Annotated[
    str, typer.Argument(metavar="AGENT", help=f"The agent. {_AGENT}", autocompletion=_agent_names)
]
AgentArguments = Annotated[
    list[str] | None,
    typer.Argument(metavar="AGENT", help=f"The agents. {_AGENT}", autocompletion=_agent_names),
]
AgentRobot = Annotated[str, typer.Option(help="Name or file of the arm; by default the arm that each agent needs.")]
Backend = Annotated[
    str | None,
    typer.Option(
        help="Where the work runs: serial, processes or ray; the results are the same.",
        show_default=False,
        rich_help_panel=PARALLEL,
    ),
]
_BANK = "Name of a shipped bank, or folder of a bank."
Bank = Annotated[str, typer.Option(help=_BANK, autocompletion=_bank_names)]
BankArgument = Annotated[str, typer.Argument(metavar="BANK", help=_BANK, autocompletion=_bank_names)]
Difficulty = Annotated[str, typer.Option(help="Difficulties of the targets, separated by commas; all by default.")]
Format = Annotated[str | None, typer.Option("--format", help="Format of the recording; detected by default.")]
NumEnvs = Annotated[int, typer.Option(min=1, help="Episodes to run at once.")]
Out = Annotated[Path, typer.Option("--out", help="Folder for the results.")]
RigFile = Annotated[
    Path | None, typer.Option("--rig", help="Rig file, written by calibrate, with the poses of the cameras.")
]
Robot = Annotated[str, typer.Option(help="Name or file of the arm.")]
SceneName = Annotated[str, typer.Option("--scene", help="Name of the scene in the bank; the first one by default.")]
Seed = Annotated[int, typer.Option(help="Seed of the first episode; each further episode adds one.")]
OneScene = Annotated[
    str | None, typer.Option("--scene", help="Name of the only scene, of any split; drawn from the split by default.")
]
OneTarget = Annotated[
    int | None,
    typer.Option(
        "--target", min=0, help="Index of the only tomato, of the scene that --scene names; drawn by default."
    ),
]
SettingsFile = Annotated[
    Path | None, typer.Option("--settings", help="TOML or JSON file of settings.", rich_help_panel=SETTINGS)
]
Target = Annotated[int, typer.Option(min=0, help="Index of the tomato in the scene.")]
Split = Annotated[str, typer.Option(help="train, validation or test.")]
Workers = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Processes on this machine; one per core by default.",
        show_default=False,
        rich_help_panel=PARALLEL,
    ),
]


def set_option(example: str) -> Any:
    """Return the option that changes single settings, with an example of the command's own."""
    text = f"A setting such as {example}; may be given several times."
    return typer.Option("--set", help=text, show_default=False, rich_help_panel=SETTINGS)


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
        "--print-settings",
        is_eager=True,
        callback=show,
        help="Print all settings with their defaults, and exit.",
        rich_help_panel=SETTINGS,
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


def given(**values: Any) -> dict[str, Any]:
    """Return the options that the user gave: those that are neither None nor empty."""
    return {name: value for name, value in values.items() if value is not None and value not in ("", ())}


def comma_separated(text: str) -> tuple[str, ...]:
    """Split a list of names at its commas."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def whole_pair(option: str, text: str, example: str) -> tuple[int, int]:
    """Return the two whole numbers of a text such as 640x480.

    Raises:
        InvalidValueError: The text is none.
    """
    from greenhouse_gym.errors import InvalidValueError

    first, _, second = text.partition("x")
    if not (first.isdecimal() and second.isdecimal()):
        raise InvalidValueError(f"{option}: expected two whole numbers such as {example}, got {text!r}")
    return int(first), int(second)
