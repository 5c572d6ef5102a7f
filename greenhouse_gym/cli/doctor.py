"""The commands doctor and list: check the installation, and list the names that commands take."""

from __future__ import annotations

import importlib
import os
import platform
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from greenhouse_gym import __version__
from greenhouse_gym.common.extras import MODULES
from greenhouse_gym.common.files import data_path
from greenhouse_gym.common.opengl_choice import opengl_choice
from greenhouse_gym.common.progress import CONSOLE, say
from greenhouse_gym.common.tables import Table
from greenhouse_gym.errors import GreenhouseError

NOT_FOR_USERS = ("all", "dev", "docs")
"""Extras that combine others or serve the development of the package."""

_REINSTALL = "the installation is incomplete: install the package again"


class Finding(NamedTuple):
    """Result of one check.

    Attributes:
        subject: Name of the part checked.
        state: "good", "missing" (an optional part is not installed) or "broken".
        result: Description of the state.
        advice: Remedy; empty if none is needed.
    """

    subject: str
    state: str
    result: str
    advice: str = ""


def doctor() -> None:
    """Check versions, cores, OpenGL, extras and data, and advise on missing or broken parts."""
    colors = {"good": "green", "missing": "yellow", "broken": "red"}
    broken = False
    for finding in findings():
        broken |= finding.state == "broken"
        CONSOLE.print(f"{finding.state:8}", style=colors[finding.state], end="", highlight=False)
        say(f"{finding.subject}: {finding.result}")
        if finding.advice:
            say(f"{'':8}-> {finding.advice}")
    if broken:
        raise typer.Exit(1)


def findings() -> Iterator[Finding]:
    """Yield the results of all checks."""
    from greenhouse_gym.agents.policy_agent import shipped_policies
    from greenhouse_gym.common.executors import usable_cores

    yield Finding("greenhouse-gym", "good", f"{__version__} in {Path(__file__).parents[1]}")
    needed = metadata.metadata("greenhouse-gym")["Requires-Python"] or ""
    python = f"{platform.python_version()} on {platform.system()} {platform.machine()} (needs {needed})"
    yield Finding("Python", "good", python)
    threads = os.environ.get("OMP_NUM_THREADS")
    yield Finding("cores", "good", f"{usable_cores()} usable" + (f", OMP_NUM_THREADS={threads}" if threads else ""))
    for extra, names in sorted(_requirements().items()):
        if extra not in NOT_FOR_USERS:
            yield _installed(extra, names)
    yield _opengl()
    yield from map(_bank, ("default", "mini"))
    policies = ", ".join(shipped_policies())
    found = f"{policies or 'none'} in {data_path('policies')}"
    yield Finding("policies", "good", found) if policies else Finding("policies", "broken", found, _REINSTALL)
    try:
        with tempfile.TemporaryFile():
            yield Finding("temporary files", "good", tempfile.gettempdir())
    except OSError as error:
        yield Finding("temporary files", "broken", f"cannot be written ({error})", "set TMPDIR to a writable folder")


def _requirements() -> dict[str, list[str]]:
    """Return the required distributions of each extra; under "" those that are always required."""
    found: dict[str, list[str]] = {}
    for requirement in metadata.requires("greenhouse-gym") or ():
        name = re.match(r"[\w.-]+", requirement)
        extra = re.search(r"extra == ['\"](\w+)['\"]", requirement)
        if name and name[0] != "greenhouse-gym":
            found.setdefault(extra[1] if extra else "", []).append(name[0])
    return found


def _installed(extra: str, names: Sequence[str]) -> Finding:
    subject = f"extra {extra}" if extra else "always needed"
    advice = f"pip install 'greenhouse-gym[{extra}]'" if extra else "pip install greenhouse-gym"
    versions, missing = [], []
    for name in names:
        try:
            versions.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        return Finding(subject, "missing" if extra else "broken", f"{', '.join(missing)} not installed", advice)
    for module in MODULES.get(extra, ()):
        try:
            _load(module)
        except Exception as error:  # compiled packages raise errors of any kind
            return Finding(subject, "broken", f"{module} is installed but cannot be imported ({error})", advice)
    return Finding(subject, "good", ", ".join(versions))


def _load(module: str) -> None:
    from greenhouse_gym.common.open3d_loader import open3d

    if module == "open3d":
        open3d()  # which also loads a shared library that it may lack
    else:
        importlib.import_module(module)


def _opengl() -> Finding:
    import mujoco

    from greenhouse_gym.rendering.opengl import OpenGLMissingError, OpenGLRenderer

    try:
        OpenGLRenderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
    except OpenGLMissingError as error:
        result = "not available; pictures are drawn by ray casting instead, at a few per second"
        return Finding("OpenGL", "missing", result, str(error).partition("; ")[2])
    return Finding("OpenGL", "good", f"works (MUJOCO_GL={opengl_choice() or 'not set'})")


def _bank(name: str) -> Finding:
    from greenhouse_gym.scene import SceneBank

    try:
        bank = SceneBank.open(name)
        bank.scene(bank.names()[0])
    except GreenhouseError as error:
        return Finding(f"bank {name}", "broken", str(error), _REINSTALL)
    missing = [entry.file for entry in bank.manifest.scenes if not (bank.path / entry.file).is_file()]
    if missing:
        return Finding(f"bank {name}", "broken", f"{bank.path} lacks {', '.join(missing)}", _REINSTALL)
    return Finding(f"bank {name}", "good", f"{len(bank)} scenes in {bank.path}")


def agent_table() -> Table:
    """Return the agents without arguments, with a line on each."""
    from greenhouse_gym.agents.named import SIMPLE

    return Table(("agent", "what it does"), [(name, _summary(kind)) for name, kind in SIMPLE.items()], words=(0, 1))


def policy_table() -> Table:
    """Return the shipped policies, with the arm and the observation that they need."""
    from greenhouse_gym.agents import load_policy
    from greenhouse_gym.agents.policy_agent import shipped_policies

    needs = {name: load_policy(name).env_options for name in shipped_policies()}
    rows = [(name, *(str(options.get(key, "")) for key in ("robot", "observation"))) for name, options in needs.items()]
    return Table(("policy", "arm", "observation"), rows, words=(0, 1, 2))


def planner_table() -> Table:
    """Return the planners, with their methods."""
    from greenhouse_gym.planning import PLANNERS

    return Table(("planner", "method"), [(name, PLANNERS[name].description) for name in PLANNERS], words=(0, 1))


def bank_table() -> Table:
    """Return the shipped banks, with the number of scenes in each split."""
    from greenhouse_gym.scene import SceneBank
    from greenhouse_gym.scene.bank import shipped_banks
    from greenhouse_gym.scene.manifest import SPLITS

    banks = {name: SceneBank.open(name) for name in shipped_banks()}
    rows = [(name, str(len(bank)), *(str(len(bank.names(split))) for split in SPLITS)) for name, bank in banks.items()]
    return Table(("bank", "scenes", *SPLITS), rows)


def arm_table() -> Table:
    """Return the arms, with the number of their joints."""
    from greenhouse_gym.robots import ROBOTS, get_robot

    return Table(("arm", "joints"), [(name, str(len(get_robot(name).joints))) for name in ROBOTS])


KINDS: dict[str, Callable[[], Table]] = {
    "agents": agent_table,
    "policies": policy_table,
    "planners": planner_table,
    "banks": bank_table,
    "arms": arm_table,
}


def list_names(
    kind: Annotated[
        str,
        typer.Argument(
            metavar="KIND",
            help=f"{', '.join(KINDS)}; all by default.",
            autocompletion=lambda: list(KINDS),
            show_default=False,
        ),
    ] = "",
) -> None:
    """List the names that commands take: agents, policies, planners, banks and arms.

    Every policy and every planner is an agent as well.
    """
    from greenhouse_gym.errors import MissingDependencyError, require_choice

    for name in [require_choice("kind", kind, KINDS)] if kind else KINDS:
        try:
            KINDS[name]().show()
        except MissingDependencyError as error:
            if kind:
                raise
            say(f"{name}: {error}")
        say("")


def _summary(kind: Callable[[], object]) -> str:
    """Return the first line of a docstring."""
    return (kind.__doc__ or "").strip().splitlines()[0]
