"""Command line of the training scripts."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TypeVar

from greenhouse_gym.common.settings_files import as_toml, resolve

Settings = TypeVar("Settings")


def parsed(description: str | None, defaults: Settings, out: str, episodes: int) -> tuple[argparse.Namespace, Settings]:
    """Parse the command line; ``--print`` prints all settings and exits.

    Args:
        description: Description of the script.
        defaults: A dataclass of settings.
        out: Default folder for the results.
        episodes: Default number of validation episodes.

    Returns:
        The arguments ``out``, ``resume`` and ``episodes``, and the settings.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(out))
    parser.add_argument("--settings", type=Path, help="TOML or JSON file of settings")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--print", action="store_true", help="print all settings and exit")
    parser.add_argument("--resume", action="store_true", help="resume the training in the folder")
    parser.add_argument("--episodes", type=int, default=episodes, help="validation episodes at the end")
    arguments = parser.parse_args()
    settings = resolve(defaults, arguments.settings, arguments.set)
    if arguments.print:
        print(as_toml(settings, comments=True), end="")
        parser.exit()
    return arguments, settings
