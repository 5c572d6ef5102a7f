"""The command doctor: what is here, what is missing, and what to do about it."""

from __future__ import annotations

import importlib
import os
import platform
import re
import tempfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import typer

from greenhouse_gym import __version__
from greenhouse_gym.common.extras import MODULES
from greenhouse_gym.common.files import data_path
from greenhouse_gym.common.progress import CONSOLE, say
from greenhouse_gym.errors import GreenhouseError

NOT_FOR_USERS = ("all", "dev", "docs")
"""Extras that gather others, or that only those need who work on the package itself."""


class Finding(NamedTuple):
    """One thing the doctor looked at.

    Attributes:
        what: Its name.
        state: "good", "missing" (something optional is not there) or "broken".
        told: What was found.
        advice: What to do about it; empty where nothing is to be done.
    """

    what: str
    state: str
    told: str
    advice: str = ""


def doctor() -> None:
    """Print versions, cores, OpenGL, extras and data, and what to do about what is missing or broken."""
    colors = {"good": "green", "missing": "yellow", "broken": "red"}
    broken = False
    for finding in findings():
        broken |= finding.state == "broken"
        CONSOLE.print(f"{finding.state:8}", style=colors[finding.state], end="", highlight=False)
        say(f"{finding.what}: {finding.told}")
        if finding.advice:
            say(f"{'':8}-> {finding.advice}")
    if broken:
        raise typer.Exit(1)


def findings() -> Iterator[Finding]:
    """Everything the doctor looks at, one after the other."""
    yield Finding("greenhouse-gym", "good", f"{__version__} in {Path(__file__).parents[1]}")
    yield _python()
    yield _cores()
    required = {name: extra for name, extra in _requirements() if extra not in NOT_FOR_USERS}
    for extra in ("", *sorted(set(required.values()) - {""})):
        yield _installed(extra, [name for name, of in required.items() if of == extra])
    yield _opengl()
    yield from _data()
    yield _temporary_folder()


def _python() -> Finding:
    asked = metadata.metadata("greenhouse-gym")["Requires-Python"] or ""
    told = f"{platform.python_version()} on {platform.system()} {platform.machine()} (needs {asked})"
    return Finding("Python", "good", told)


def _cores() -> Finding:
    from greenhouse_gym.common.executors import usable_cores

    cores = usable_cores()
    threads = os.environ.get("OMP_NUM_THREADS")
    return Finding("cores", "good", f"{cores} usable" + (f", OMP_NUM_THREADS={threads}" if threads else ""))


def _requirements() -> Iterator[tuple[str, str]]:
    """Distributions the package asks for, with the extra that brings each; "" for those it always needs."""
    for requirement in metadata.requires("greenhouse-gym") or ():
        name = re.match(r"[\w.-]+", requirement)
        extra = re.search(r"extra == ['\"](\w+)['\"]", requirement)
        if name and name[0] != "greenhouse-gym":
            yield name[0], extra[1] if extra else ""


def _installed(extra: str, names: list[str]) -> Finding:
    what = f"extra {extra}" if extra else "always needed"
    advice = f"pip install 'greenhouse-gym[{extra}]'" if extra else "pip install greenhouse-gym"
    versions, missing = [], []
    for name in names:
        try:
            versions.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        return Finding(what, "missing" if extra else "broken", f"{', '.join(missing)} not installed", advice)
    for module in MODULES.get(extra, ()):
        try:
            _load(module)
        except Exception as error:  # compiled packages fail in ways of their own
            return Finding(what, "broken", f"{module} is installed but cannot be imported ({error})", advice)
    return Finding(what, "good", ", ".join(versions))


def _load(module: str) -> None:
    from greenhouse_gym.common.open3d_loader import open3d

    if module == "open3d":
        open3d()  # which finds it a library that it may lack
    else:
        importlib.import_module(module)


def _opengl() -> Finding:
    import mujoco

    from greenhouse_gym.rendering.opengl import OpenGLMissingError, OpenGLRenderer

    try:
        OpenGLRenderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
    except OpenGLMissingError as error:
        told = "none; pictures are drawn by ray casting instead, at a few per second"
        return Finding("OpenGL", "missing", told, str(error).partition("; ")[2])
    return Finding("OpenGL", "good", f"works (MUJOCO_GL={os.environ.get('MUJOCO_GL', 'not set')})")


def _data() -> Iterator[Finding]:
    from greenhouse_gym.agents.policy_agent import shipped_policies
    from greenhouse_gym.scene import SceneBank

    again = "the installation is incomplete: install the package again"
    for name in ("default", "mini"):
        try:
            bank = SceneBank.open(name)
            bank.scene(bank.names()[0])
        except GreenhouseError as error:
            yield Finding(f"bank {name}", "broken", str(error), again)
            continue
        missing = [entry.file for entry in bank.manifest.scenes if not (bank.path / entry.file).is_file()]
        if missing:
            yield Finding(f"bank {name}", "broken", f"{bank.path} lacks {', '.join(missing)}", again)
        else:
            yield Finding(f"bank {name}", "good", f"{len(bank)} scenes in {bank.path}")
    policies = ", ".join(shipped_policies())
    if policies:
        yield Finding("policies", "good", f"{policies} in {data_path('policies')}")
    else:
        yield Finding("policies", "broken", f"none in {data_path('policies')}", again)


def _temporary_folder() -> Finding:
    try:
        with tempfile.TemporaryFile():
            pass
    except OSError as error:
        return Finding("temporary files", "broken", f"cannot be written ({error})", "set TMPDIR to a folder that can")
    return Finding("temporary files", "good", tempfile.gettempdir())
