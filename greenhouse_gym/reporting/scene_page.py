"""A scene on one page, to be turned and looked at in a browser: shapes, truth, seen space, the arm on its witnesses."""

from __future__ import annotations

import base64
import json
import re
from collections import Counter
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np

from greenhouse_gym.export.arm import links_of
from greenhouse_gym.export.primitives import Primitive, primitives
from greenhouse_gym.export.xml import arm_pose
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.seen import SURFACE, UNSEEN, SeenSpace

_TRUE_COLOR = (0.20, 0.35, 0.80)
_UNSEEN_COLOR = (0.25, 0.25, 0.30)
_SURFACE_COLOR = (0.85, 0.60, 0.15)
_DOT = 0.012  # size of a voxel's dot, as a share of the picture's height at a metre
_KINDS = {"sphere": 0, "ellipsoid": 0, "capsule": 1, "cylinder": 2, "box": 3}


def scene_page(scene: Scene, robot: Robot) -> str:
    """The page: one HTML file without a network, some hundred kilobytes. It needs WebGL 2, which browsers have."""
    layers = [_solid("reconstruction", primitives(scene), 1.0, True)]
    if scene.truth is not None:
        true = [part._replace(color=_TRUE_COLOR) for part in primitives(scene.truth)]
        layers.append(_solid("truth", true, 0.45, False))
    if scene.seen is not None:
        layers.append(_dots("unseen space (its border)", _border(scene.seen), _UNSEEN_COLOR, 0.35))
        surface = scene.seen.centers[scene.seen.states == SURFACE]
        layers.append(_dots("surface that was seen", surface, _SURFACE_COLOR, 0.8))
    data = {
        "layers": layers,
        "links": _links(scene, robot),
        "start": robot.start.tolist(),
        "targets": [
            {"name": f"{target.tomato}: {target.difficulty}", "path": [list(q) for q in target.witness]}
            for target in scene.targets
            if target.witness is not None and target.robot == robot.name
        ],
    }
    facts = "".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in _facts(scene))
    page = files("greenhouse_gym.reporting").joinpath("scene_page.html").read_text()
    # "<" is written so that no name in the data can end the script element
    return _Page(page).substitute(title=escape(scene.name), facts=facts, data=json.dumps(data).replace("<", "\\u003c"))


class _Page(Template):
    """Only these three are places to fill: JavaScript has uses of its own for dollar signs."""

    idpattern = "title|facts|data"
    flags = re.NOFLAG


def _facts(scene: Scene) -> list[tuple[str, str]]:
    told = scene.provenance
    counts = Counter(target.difficulty for target in scene.targets)
    facts = [
        ("row", told.row),
        ("week", "" if told.week is None else str(told.week)),
        ("style", told.style or ""),
        ("source", told.source or ""),
        ("protocol", told.protocol or ""),
        ("shapes", f"{len(scene.tomatoes)} tomatoes, {len(scene.stems)} stems, {len(scene.clutter)} clutter"),
        ("truth", "" if scene.truth is None else f"{len(scene.truth.obstacles)} shapes"),
        ("targets", ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))),
    ]
    return [(name, text) for name, text in facts if text]


def _solid(name: str, parts: Sequence[Primitive], opacity: float, shown: bool) -> dict[str, Any]:
    return {"name": name, "solids": _table(parts), "opacity": opacity, "shown": shown}


def _dots(name: str, points: Array, color: tuple[float, float, float], opacity: float) -> dict[str, Any]:
    millimetres = _text(np.rint(1000 * points).astype("<i2"))
    return {"name": name, "dots": millimetres, "color": color, "opacity": opacity, "shown": False, "size": _DOT}


def _border(space: SeenSpace) -> Array:
    """(n, 3) middles of the unseen voxels that have a seen neighbor."""
    unseen = space.states == UNSEEN
    seen = np.pad(~unseen, 1)
    beside = np.zeros_like(unseen)
    for axis in range(3):
        for step in (-1, 1):
            beside |= np.roll(seen, step, axis)[1:-1, 1:-1, 1:-1]
    return space.centers[unseen & beside]


def _links(scene: Scene, robot: Robot) -> list[dict[str, Any]]:
    """The arm's links, the tip last, as the page's script moves them."""
    links = links_of(robot)
    number = {link.name: k for k, link in enumerate(links)}
    return [
        {
            "parent": -1 if link.parent is None else number[link.parent],
            "pose": (arm_pose(scene, robot) @ link.pose if link.parent is None else link.pose).T.flatten().tolist(),
            "joint": robot.joints.index(link.joint.name) if link.joint.name in robot.joints else -1,
            "slides": link.joint.kind == "prismatic",
            "axis": link.joint.axis.tolist(),
            "solids": _table(link.parts),
        }
        for link in links
    ]


def _table(parts: Sequence[Primitive]) -> str:
    """Primitives as the page's script reads them: 19 numbers each."""
    rows = []
    for part in parts:
        size = part.size * 3 if part.kind == "sphere" else (*part.size, 0.0)[:3]
        rows.append([_KINDS[part.kind], *size, *part.pose[:3].flatten(), *part.color])
    return _text(np.array(rows, dtype="<f4"))


def _text(values: Any) -> str:
    return base64.b64encode(values.tobytes()).decode("ascii")
