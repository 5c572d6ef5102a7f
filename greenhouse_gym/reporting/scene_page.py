"""A scene on one page, to be turned and looked at in a browser: shapes, truth, seen space, the arm on its ways."""

from __future__ import annotations

import base64
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from string import Template
from typing import Any, NamedTuple

import numpy as np

from greenhouse_gym.export.arm import links_of
from greenhouse_gym.export.primitives import Primitive, primitives
from greenhouse_gym.export.xml import arm_pose
from greenhouse_gym.geometry import Array, pose
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.occupancy import OCCUPIED, UNKNOWN, OccupancyGrid

_TRUE_COLOR = (0.20, 0.35, 0.80)
_UNKNOWN_COLOR = (0.25, 0.25, 0.30)
_OCCUPIED_COLOR = (0.85, 0.60, 0.15)
_WITNESS_COLOR = (0.85, 0.10, 0.55)
_TARGET_COLOR = (0.95, 0.75, 0.05)
_DOT = 0.012  # size of a voxel's dot, as a share of the picture's height at a metre
_KINDS = {"sphere": 0, "ellipsoid": 0, "capsule": 1, "cylinder": 2, "box": 3}


class Motion(NamedTuple):
    """A way of the arm.

    Attributes:
        name: Whose it is.
        joints: (k, joints) positions, radians.
        color: RGB in [0, 1] of the tip's way.
        told: What came of it.
    """

    name: str
    joints: Array
    color: tuple[float, float, float]
    told: str = ""


@dataclass(frozen=True, eq=False)
class Episode:
    """What agents did from one start to one target.

    Attributes:
        title: What to call it.
        target: Index of the target tomato.
        motions: A way of each agent.
        true_world: Whether the true row was touched, not the reconstruction.
    """

    title: str
    target: int
    motions: tuple[Motion, ...]
    true_world: bool = False


def scene_page(scene: Scene, robot: Robot, episode: Episode | None = None) -> str:
    """The page: one HTML file without a network, some hundred kilobytes. It needs WebGL 2, which browsers have.

    Args:
        scene: The scene.
        robot: The arm.
        episode: Whose ways of the arm to draw, all together; None has the scene's witnesses, one at a time.
    """
    true_world = episode is not None and episode.true_world
    layers = [_solid("reconstruction", primitives(scene), 1.0, not true_world)]
    if scene.truth is not None:
        # beside the reconstruction it must look different, alone it may look as it is
        true = [part if true_world else part._replace(color=_TRUE_COLOR) for part in primitives(scene.truth)]
        layers.append(_solid("truth", true, 1.0 if true_world else 0.45, true_world))
    if episode is None:
        layers += _seen(scene)
        view, facts, title = _witnesses(scene, robot), _facts(scene), scene.name
    else:
        tomato = scene.tomatoes[episode.target]
        around = Primitive("target", "sphere", (1.35 * tomato.radius,), pose(translation=tomato.center), _TARGET_COLOR)
        layers.append(_solid("target", [around], 0.45, True))
        view, title = _agents(episode), episode.title
        facts = [(motion.name, motion.told) for motion in episode.motions]
    data = {"layers": layers, "links": _links(scene, robot), "start": robot.start.tolist(), **view}
    told = "".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in facts)
    page = files("greenhouse_gym.reporting").joinpath("scene_page.html").read_text()
    # "<" is written so that no name in the data can end the script element
    return _Page(page).substitute(title=escape(title), facts=told, data=json.dumps(data).replace("<", "\\u003c"))


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


def _witnesses(scene: Scene, robot: Robot) -> dict[str, Any]:
    """The witnesses, of which one at a time is shown."""
    motions = [
        Motion(f"{target.tomato}: {target.difficulty}", np.asarray(target.witness), _WITNESS_COLOR)
        for target in scene.targets
        if target.witness is not None and target.robot == robot.name
    ]
    drawn = [_motion(motion) for motion in motions]
    look = {"far": 3.2, "middle": [0.35, 0.0, 1.2]}
    return {"legend": "witness", "choice": "target", "together": False, "motions": drawn, **look}


def _agents(episode: Episode) -> dict[str, Any]:
    """What agents did, all of which is shown, seen from nearer."""
    drawn = [_motion(motion) for motion in episode.motions]
    look = {"far": 2.7, "middle": [0.35, 0.0, 1.35]}
    return {"legend": "agent", "choice": "arm of", "together": True, "motions": drawn, **look}


def _motion(motion: Motion) -> dict[str, Any]:
    return {"name": motion.name, "path": np.round(motion.joints, 5).tolist(), "color": motion.color}


def _seen(scene: Scene) -> list[dict[str, Any]]:
    """What the scan saw of space, where that is known."""
    if scene.occupancy is None:
        return []
    surface = scene.occupancy.centers[scene.occupancy.states == OCCUPIED]
    return [
        _dots("unknown space (its border)", _border(scene.occupancy), _UNKNOWN_COLOR, 0.35),
        _dots("surface that was seen", surface, _OCCUPIED_COLOR, 0.8),
    ]


def _solid(name: str, parts: Sequence[Primitive], opacity: float, shown: bool) -> dict[str, Any]:
    return {"name": name, "solids": _table(parts), "opacity": opacity, "shown": shown}


def _dots(name: str, points: Array, color: tuple[float, float, float], opacity: float) -> dict[str, Any]:
    millimetres = _text(np.rint(1000 * points).astype("<i2"))
    return {"name": name, "dots": millimetres, "color": color, "opacity": opacity, "shown": False, "size": _DOT}


def _border(space: OccupancyGrid) -> Array:
    """(n, 3) middles of the unknown voxels that have a seen neighbor."""
    unknown = space.states == UNKNOWN
    seen = np.pad(~unknown, 1)
    beside = np.zeros_like(unknown)
    for axis in range(3):
        for step in (-1, 1):
            beside |= np.roll(seen, step, axis)[1:-1, 1:-1, 1:-1]
    return space.centers[unknown & beside]


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
