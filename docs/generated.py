"""Reference tables that the site builds from the code: commands, observations, planners, formats and file schemas."""

from __future__ import annotations

import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Callable, Iterator
from textwrap import indent
from typing import Any

import numpy as np
from gymnasium import spaces
from pydantic import BaseModel
from typer.main import get_command

from greenhouse_gym.agents.policy import Description
from greenhouse_gym.capture import recording_formats
from greenhouse_gym.capture.formats.own import RecordingIndex
from greenhouse_gym.cli import app
from greenhouse_gym.envs.choices import OBSERVATIONS
from greenhouse_gym.envs.tasks import TomatoReach
from greenhouse_gym.planning import PAPER_PLANNERS, PLANNERS
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.manifest import Manifest

HEADS = ("field", "type", "default", "meaning")
"""Columns of a file's schema."""

ARMS = ("ur5e", "iiwa14")
"""Arms whose observations are listed."""


def commands() -> str:
    """Return all commands with their arguments and options, as ``--help`` prints them."""
    return "\n".join(_command(get_command(app), "greenhouse-gym"))


def observations() -> str:
    """Return the layout of every observation by name, for each shipped arm."""
    return "\n".join(line for name in OBSERVATIONS for line in _observation(name))


def planners() -> str:
    """Return all planners with their descriptions."""
    rows = [
        (f"`{name}`", info.description, _mark(name in PAPER_PLANNERS), _mark(info.optimizing), _mark(info.reproducible))
        for name, info in PLANNERS.items()
    ]
    return _table(("planner", "method", "in the paper", "optimizing", "same seed, same path"), rows)


def formats() -> str:
    """Return all formats of recordings that come with the package."""
    return _table(("format", "content"), [(f"`{one.name}`", one.description) for one in recording_formats().values()])


def recording_schema() -> str:
    """Return the fields of ``recording.json``."""
    return _schema(RecordingIndex)


def scene_schema() -> str:
    """Return the fields of a scene file."""
    return _schema(Scene)


def manifest_schema() -> str:
    """Return the fields of ``manifest.json``."""
    return _schema(Manifest)


def policy_schema() -> str:
    """Return the fields of ``policy.json``."""
    return _schema(Description)


TABLES: dict[str, Callable[[], str]] = {
    function.__name__: function
    for function in (
        commands,
        observations,
        planners,
        formats,
        recording_schema,
        scene_schema,
        manifest_schema,
        policy_schema,
    )
}
"""Tables by the name in the comment that they replace, ``<!-- generated: NAME -->``."""


def insert_tables(markdown: str) -> str:
    """Replace the comments that name a table by the table."""
    return re.sub(r"( *)<!-- generated: (\w+) -->", lambda found: indent(TABLES[found[2]](), found[1]), markdown)


def _table(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [heads, ("---",) * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _mark(value: bool) -> str:
    return "yes" if value else ""


# -- commands ---------------------------------------------------------------------------------------------------------


def _command(command: Any, name: str) -> list[str]:
    """Return the lines of a command, or of the commands in a group."""
    if subcommands := getattr(command, "commands", None):
        shown = {key: child for key, child in subcommands.items() if not child.hidden}
        return [line for key, child in shown.items() for line in _command(child, f"{name} {key}")]
    context = command.make_context(name, [], resilient_parsing=True)
    usage = " ".join(command.collect_usage_pieces(context))
    lines = [f"## {name.removeprefix('greenhouse-gym ')}", "", f"`{name} {usage}`", "", command.help or "", ""]
    rows = [_parameter(parameter) for parameter in command.params if parameter.name != "help"]
    return [*lines, _table(("option", "meaning", "default"), rows)] if rows else lines


def _parameter(parameter: Any) -> tuple[str, str, str]:
    shown = ", ".join(parameter.opts) if parameter.opts[0].startswith("-") else parameter.metavar or parameter.name
    default = parameter.default
    default = "" if default in (None, "", False, ...) or parameter.required or callable(default) else f"`{default}`"
    return f"`{shown}`", (getattr(parameter, "help", None) or "").replace("|", "\\|"), default


# -- observations -----------------------------------------------------------------------------------------------------


def _observation(name: str) -> Iterator[str]:
    made = [OBSERVATIONS[name](get_robot(arm), TomatoReach()) for arm in ARMS]
    yield f"## {name}\n"
    if isinstance(made[0].space, spaces.Dict):
        rows = [
            (
                f"`{key}`",
                f"`{made[0].space[key].shape}`",
                f"`{made[1].space[key].shape}`",
                f"{made[0].space[key].dtype}",
            )
            for key in made[0].space
        ]
        yield _table(("key", *(f"shape, {arm}" for arm in ARMS), "type"), rows)
    if made[0].layout:
        yield _table(
            ("feature", *(f"entries, {arm}" for arm in ARMS), "bounds"),
            [
                (f"`{feature}`", *(_entries(one.layout, k) for one in made), _bounds(made[0], k))
                for k, (feature, _) in enumerate(made[0].layout)
            ],
        )


def _entries(layout: Any, k: int) -> str:
    first, size = sum(size for _, size in layout[:k]), layout[k][1]
    return f"{first} to {first + size - 1}" if size > 1 else f"{first}"


def _bounds(observation: Any, k: int) -> str:
    first, size = sum(size for _, size in observation.layout[:k]), observation.layout[k][1]
    parts = [observation.space] if isinstance(observation.space, spaces.Box) else list(observation.space.values())
    (vector,) = (part for part in parts if part.shape == (sum(size for _, size in observation.layout),))
    low, high = (np.unique(bound[first : first + size]) for bound in (vector.low, vector.high))
    return f"{low[0]:.3g} to {high[0]:.3g}" if len(low) == len(high) == 1 else "by joint"


# -- file schemas -----------------------------------------------------------------------------------------------------


def _schema(model: type) -> str:
    """Return tables of the fields of a model and of the models in it, each model once."""
    waiting, done = [model], list[type]()
    parts = []
    while waiting:
        current = waiting.pop(0)
        if current in done:
            continue
        done.append(current)
        summary = inspect.cleandoc(current.__doc__ or "").partition("\n\n")[0].replace("\n", " ").replace("``", "`")
        parts.append(f"**{_title(current)}**: {summary}\n\n{_table(HEADS, _fields(current))}")
        waiting += [inner for hint in _hints(current).values() for inner in _models(hint)]
    return "\n".join(parts)


def _title(model: type) -> str:
    return model.__name__.lstrip("_")


def _hints(model: type) -> dict[str, Any]:
    hints = typing.get_type_hints(model, include_extras=True)
    return {name: hints[name] for name in _defaults(model)}


def _defaults(model: type) -> dict[str, str]:
    """Return the defaults of the fields of a model, "required" without one."""
    if issubclass(model, BaseModel):
        fields = model.model_fields
        return {
            name: "required" if one.is_required() else _default(one.get_default(call_default_factory=True))
            for name, one in fields.items()
        }
    return {
        one.name: "required"
        if one.default is one.default_factory is dataclasses.MISSING
        else _default(one.default if one.default is not dataclasses.MISSING else one.default_factory())
        for one in dataclasses.fields(model)
    }


def _default(value: Any) -> str:
    return f"`{value}`" if isinstance(value, str | int | float) and value != "" else ""


def _fields(model: type) -> list[tuple[str, ...]]:
    meanings, defaults = _meanings(model), _defaults(model)
    return [(f"`{name}`", _type(hint), defaults[name], meanings.get(name, "")) for name, hint in _hints(model).items()]


def _meanings(model: type) -> dict[str, str]:
    """Return the attributes that the docstrings of a model and its bases describe."""
    found = dict[str, str]()
    for one in reversed(model.__mro__):
        _, _, attributes = inspect.cleandoc(vars(one).get("__doc__") or "").partition("Attributes:\n")
        text = re.sub(r"\n {5,}", " ", attributes)
        found |= dict(re.findall(r"^ {4}(\w+): (.*)$", text.replace("``", "`"), re.M))
    return found


def _models(hint: Any) -> Iterator[type]:
    """Yield the models that a type refers to."""
    if isinstance(hint, type) and (issubclass(hint, BaseModel) or dataclasses.is_dataclass(hint)):
        yield hint
    for inner in typing.get_args(hint):
        yield from _models(inner)


def _type(hint: Any) -> str:
    """Return a type as a reader of JSON would call it."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        shapes = [one.shape for one in inner[1:] if hasattr(one, "shape")]
        return f"numbers {shapes[0]}" if shapes else _type(inner[0])
    if origin is typing.Literal:
        return " or ".join(f"`{value!r}`".replace("'", '"') for value in inner)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_type(one) for one in inner if one is not type(None))
    if origin in (list, tuple):
        return "list" if not inner else f"list of {_type(inner[0])}"
    if origin is dict:
        return f"mapping from {_type(inner[0])} to {_type(inner[1])}"
    names = {str: "text", int: "integer", float: "number", bool: "true or false", Any: "any", np.ndarray: "numbers"}
    return names.get(hint) or (_title(hint) if isinstance(hint, type) else str(hint))
