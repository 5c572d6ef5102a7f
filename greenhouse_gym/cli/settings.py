"""Options by which every setting of a command can be given: a file, single fields, and a list of what there is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

SettingsFile = Annotated[Path | None, typer.Option("--settings", help="TOML or JSON file of settings.")]
Assignments = Annotated[
    list[str] | None,
    typer.Option("--set", help="A setting such as voxel=0.004; may be given again.", show_default=False),
]


def shown(defaults: Callable[[], object]) -> Any:
    """The option that prints all settings with their defaults, and what each is, as a file to begin from.

    Args:
        defaults: Gives the settings; called when they are to be shown.
    """

    def show(wanted: bool) -> None:
        if wanted:
            from greenhouse_gym.common.settings_files import as_toml

            typer.echo(as_toml(defaults(), comments=True), nl=False)
            raise typer.Exit

    return typer.Option(
        "--print-settings", is_eager=True, callback=show, help="Print all settings and their defaults, and do no more."
    )
