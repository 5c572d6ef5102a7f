"""A scene on one page, to turn and look at in a browser: shapes, truth, occupancy, and the arm on its paths."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from greenhouse_gym.export.primitives import Primitive, primitives
from greenhouse_gym.export.xml import links_of
from greenhouse_gym.geometry import Array, pose
from greenhouse_gym.reporting.pages import render
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import arm_pose
from greenhouse_gym.scene.occupancy import OCCUPIED, UNKNOWN

_TRUTH_COLOR = (0.20, 0.35, 0.80)
_UNKNOWN_COLOR = (0.25, 0.25, 0.30)
_OCCUPIED_COLOR = (0.85, 0.60, 0.15)
_WITNESS_COLOR = (0.85, 0.10, 0.55)
_TARGET_COLOR = (0.95, 0.75, 0.05)
_DOT = 0.012  # size of a voxel's dot, as a fraction of the picture's height at a metre
_KINDS = {"sphere": 0, "ellipsoid": 0, "capsule": 1, "cylinder": 2, "box": 3}


class Motion(NamedTuple):
    """Path of the arm with its name and color.

    Attributes:
        name: Name of the agent.
        joints: (k, joints) positions, radians.
        color: RGB in [0, 1] of the tip's path.
        outcome: How it ended.
    """

    name: str
    joints: Array
    color: tuple[float, float, float]
    outcome: str = ""


class Replay(NamedTuple):
    """The paths of agents from one start to one target.

    Attributes:
        title: Heading.
        target: Index of the target tomato.
        motions: One path for each agent.
        in_truth: Whether contacts were with the true row, not with the reconstruction.
    """

    title: str
    target: int
    motions: tuple[Motion, ...]
    in_truth: bool = False


def scene_page(scene: Scene, robot: Robot, replay: Replay | None = None) -> str:
    """Return a scene as one HTML file of some hundred kilobytes that needs no network, only WebGL 2.

    Args:
        scene: The scene.
        robot: The arm.
        replay: Paths to draw, all together; None draws the scene's witnesses, one at a time.
    """
    in_truth = replay is not None and replay.in_truth
    layers = [_solid("reconstruction", primitives(scene), 1.0, not in_truth)]
    if scene.truth is not None:
        # next to the reconstruction the truth must look different, alone it keeps its colors
        true = [part if in_truth else part._replace(color=_TRUTH_COLOR) for part in primitives(scene.truth)]
        layers.append(_solid("truth", true, 1.0 if in_truth else 0.45, in_truth))
    if replay is None:
        layers += _occupancy(scene)
        view, facts, title = _witnesses(scene, robot), _facts(scene), scene.name
    else:
        tomato = scene.tomatoes[replay.target]
        around = Primitive("target", "sphere", (1.35 * tomato.radius,), pose(translation=tomato.center), _TARGET_COLOR)
        layers.append(_solid("target", [around], 0.45, True))
        view, title = _paths(replay), replay.title
        facts = [(motion.name, motion.outcome) for motion in replay.motions]
    data = {"layers": layers, "links": _links(scene, robot), "start": robot.start.tolist(), **view}
    return render("scene.html", title=title, facts=facts, data=data)


def _facts(scene: Scene) -> list[tuple[str, str]]:
    source = scene.provenance
    counts = Counter(target.difficulty for target in scene.targets)
    facts = [
        ("row", source.row),
        ("week", "" if source.week is None else str(source.week)),
        ("style", source.style or ""),
        ("source", source.source or ""),
        ("protocol", source.protocol or ""),
        ("shapes", f"{len(scene.tomatoes)} tomatoes, {len(scene.stems)} stems, {len(scene.clutter)} clutter"),
        ("truth", "" if scene.truth is None else f"{scene.truth.count} shapes"),
        ("targets", ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))),
    ]
    return [(name, text) for name, text in facts if text]


def _witnesses(scene: Scene, robot: Robot) -> dict[str, Any]:
    """Return the scene's witnesses, to be shown one at a time."""
    motions = [
        Motion(f"{target.tomato}: {target.difficulty}", np.asarray(target.witness), _WITNESS_COLOR)
        for target in scene.targets
        if target.witness is not None and target.robot == robot.name
    ]
    view = {"legend": "witness", "choice": "target", "together": False, "far": 3.2, "middle": [0.35, 0.0, 1.2]}
    return view | {"motions": [_motion(motion) for motion in motions]}


def _paths(replay: Replay) -> dict[str, Any]:
    """Return the agents' paths, which the page shows all at once and from a nearer viewpoint."""
    view = {"legend": "agent", "choice": "arm of", "together": True, "far": 2.7, "middle": [0.35, 0.0, 1.35]}
    return view | {"motions": [_motion(motion) for motion in replay.motions]}


def _motion(motion: Motion) -> dict[str, Any]:
    return {"name": motion.name, "path": np.round(motion.joints, 5).tolist(), "color": motion.color}


def _occupancy(scene: Scene) -> list[dict[str, Any]]:
    """Return the occupied cells of the occupancy grid and the border of its unknown space, if the scene has one."""
    grid = scene.occupancy
    if grid is None:
        return []
    unknown = grid.states == UNKNOWN
    border = unknown & binary_dilation(~unknown)
    return [
        _dots("border of unknown space", grid.centers[border], _UNKNOWN_COLOR, 0.35),
        _dots("occupied cells", grid.centers[grid.states == OCCUPIED], _OCCUPIED_COLOR, 0.8),
    ]


def _solid(name: str, parts: Sequence[Primitive], opacity: float, shown: bool) -> dict[str, Any]:
    return {"name": name, "solids": _table(parts), "opacity": opacity, "shown": shown}


def _dots(name: str, points: Array, color: tuple[float, float, float], opacity: float) -> dict[str, Any]:
    millimetres = _text(np.rint(1000 * points).astype("<i2"))
    return {"name": name, "dots": millimetres, "color": color, "opacity": opacity, "shown": False, "size": _DOT}


def _links(scene: Scene, robot: Robot) -> list[dict[str, Any]]:
    """Return the arm's links, the tip last, as the page's script moves them."""
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
    """Encode primitives as the page's script reads them: 19 numbers each."""
    rows = []
    for part in parts:
        size = part.size * 3 if part.kind == "sphere" else (*part.size, 0.0)[:3]
        rows.append([_KINDS[part.kind], *size, *part.pose[:3].flatten(), *part.color])
    return _text(np.array(rows, dtype="<f4"))


def _text(values: Any) -> str:
    return base64.b64encode(values.tobytes()).decode("ascii")
