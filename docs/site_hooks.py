"""Hooks of the documentation site: pictures of the benchmarks, the page of commands, and a check of foreign links."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from typer.main import get_command

from greenhouse_gym.cli import app

ROOT = Path(__file__).parent.parent
RESULTS = "benchmarks/results"

FOREIGN = re.compile(r"<(?:script|img|iframe|source|video)[^>]*\ssrc=[\"']?(?:https?:)?//[^\s>]*")
STYLES = re.compile(
    r"<link[^>]*rel=[\"']?(?:stylesheet|preconnect|icon|preload)[\"'\s][^>]*href=[\"']?(?:https?:)?//[^>]*"
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the files of benchmark results, to which pages refer by their paths in the repository."""
    for path in sorted((ROOT / RESULTS).rglob("*")):
        if path.suffix in (".png", ".jpg", ".gif", ".json"):
            name = path.relative_to(ROOT).as_posix()
            files.append(File(name, str(ROOT), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Redirect links to the site's copies of benchmark results, and insert the commands."""
    markdown = re.sub(rf"\]\(\.\./((?:\.\./)*{RESULTS}/)", r"](\1", markdown)
    return (
        markdown.replace("<!-- commands -->", commands()) if page.file.src_uri == "reference/commands.md" else markdown
    )


def commands() -> str:
    """Return all commands with their arguments and options, as ``--help`` prints them."""
    return "\n".join(_command(get_command(app), "greenhouse-gym"))


def _command(command: Any, name: str) -> list[str]:
    """Return the lines of a command, or of the commands in a group."""
    if subcommands := getattr(command, "commands", None):
        shown = {key: child for key, child in subcommands.items() if not child.hidden}
        return [line for key, child in shown.items() for line in _command(child, f"{name} {key}")]
    context = command.make_context(name, [], resilient_parsing=True)
    usage = " ".join(command.collect_usage_pieces(context))
    lines = [f"## {name.removeprefix('greenhouse-gym ')}", "", f"`{name} {usage}`", "", command.help or "", ""]
    rows = [_row(parameter) for parameter in command.params if parameter.name != "help"]
    return [*lines, "| | | default |", "|---|---|---|", *rows, ""] if rows else lines


def _row(parameter: Any) -> str:
    shown = ", ".join(parameter.opts) if parameter.opts[0].startswith("-") else parameter.metavar or parameter.name
    default = parameter.default
    default = "" if default in (None, "", False, ...) or parameter.required or callable(default) else f"`{default}`"
    text = (getattr(parameter, "help", None) or "").replace("|", "\\|")
    return f"| `{shown}` | {text} | {default} |"


def on_post_build(config: MkDocsConfig) -> None:
    """Raise an error if a page would load anything from the network."""
    for page in Path(config.site_dir).rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        foreign = FOREIGN.search(text) or STYLES.search(text)
        if foreign:
            raise PluginError(f"{page} loads something from the network: {foreign[0][:120]}")
    for sheet in Path(config.site_dir).rglob("*.css"):
        if re.search(r"url\([\"']?(?:https?:)?//|@import", sheet.read_text(encoding="utf-8")):
            raise PluginError(f"{sheet} loads something from the network")
