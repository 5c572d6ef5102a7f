"""One function that writes a scene in any of the formats."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.export import meshes, moveit, problems, xml
from greenhouse_gym.export.primitives import primitives
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.obstacles import Shapes


class Format(NamedTuple):
    """One format.

    Attributes:
        summary: What it is, and what it leaves out.
        suffix: Suffix of the file; empty for formats of several files, which go to a folder of the scene's name.
        write: The content of the file, of a scene, an arm and the shapes that are asked for: the scene's or its truth.
    """

    summary: str
    suffix: str
    write: Callable[[Scene, Robot, Shapes], bytes]


FORMATS: Mapping[str, Format] = MappingProxyType(
    {
        "mjcf": Format("MuJoCo's scene and arm", ".xml", lambda scene, arm, _: scene.to_mjcf(arm).encode()),
        "urdf": Format("scene and arm; capsules as cylinder and spheres", ".urdf", lambda s, arm, _: xml.urdf(s, arm)),
        "sdf": Format("a world of scene and arm, as Gazebo reads it", ".sdf", lambda s, arm, _: xml.sdf(s, arm)),
        "moveit": Format(
            "MoveIt's planning scene as text",
            ".scene",
            lambda s, _, shapes: moveit.scene_text(s.name, primitives(shapes)),
        ),
        "ply": Format("a mesh with colors", ".ply", lambda s, _, shapes: meshes.ply(primitives(shapes))),
        "obj": Format("a mesh, an object per shape", ".obj", lambda s, _, shapes: meshes.obj(primitives(shapes))),
        "stl": Format("a mesh", ".stl", lambda s, _, shapes: meshes.stl(primitives(shapes))),
        "vamp": Format("problems for VAMP; stems stay capsules", ".vamp.json", lambda s, arm, _: problems.vamp(s, arm)),
        "robometrics": Format(
            "problems for robometrics; spheres and capsules as the cylinders around them",
            ".robometrics.yaml",
            lambda s, arm, _: problems.robometrics(s, arm),
        ),
    }
)
"""The formats of one file each; ``motionbenchmaker`` is a folder of pairs of files."""

FOLDER_FORMAT = "motionbenchmaker"
_OF_TRUTH = ("moveit", "ply", "obj", "stl")


def export_scene(
    scene: Scene, format: str, out: str | Path, robot: str | Robot = "ur5e", truth: bool = False
) -> list[Path]:
    """Write a scene in a format of others.

    Args:
        scene: The scene.
        format: A key of `FORMATS`, or "motionbenchmaker".
        out: Folder for the files.
        robot: Name or file of the arm, or a `Robot`.
        truth: Write what really stands there instead of what was reconstructed; meshes and MoveIt's scene alone.

    Returns:
        The files.

    Raises:
        UnknownNameError: There is no such format.
        InvalidValueError: The truth is asked for where the scene has none, or the format has no place for it.
    """
    require_choice("export format", format, [*FORMATS, FOLDER_FORMAT])
    arm, folder = get_robot(robot), Path(out)
    shapes: Shapes = scene
    if truth:
        if scene.truth is None or format not in _OF_TRUTH:
            lacking = "has no truth" if scene.truth is None else f"truth goes into {', '.join(_OF_TRUTH)} alone"
            raise InvalidValueError(f"scene {scene.name!r} cannot be written with its truth as {format}: {lacking}")
        shapes = scene.truth
    if format == FOLDER_FORMAT:
        return problems.motion_bench_maker(scene, arm, folder / scene.name)
    chosen = FORMATS[format]
    stem = f"{scene.name}-truth" if truth else scene.name
    return [write_atomically(folder / f"{stem}{chosen.suffix}", chosen.write(scene, arm, shapes))]
