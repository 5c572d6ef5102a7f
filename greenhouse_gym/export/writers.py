"""Export of a scene to any of the known formats."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.export import problems, xml
from greenhouse_gym.export.primitives import obj, ply, primitives, stl
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.obstacles import Shapes


class Format(NamedTuple):
    """A format of one file.

    Attributes:
        summary: Contents, and what is left out.
        suffix: Suffix of the file.
        write: Returns the file's content, given a scene, an arm and the shapes to write: the scene's or the true ones.
    """

    summary: str
    suffix: str
    write: Callable[[Scene, Robot, Shapes], bytes]


FORMATS: Mapping[str, Format] = MappingProxyType(
    {
        "mjcf": Format("scene and arm for MuJoCo", ".xml", lambda scene, arm, _: scene.to_mjcf(arm).encode()),
        "urdf": Format("scene and arm; capsules as cylinder and spheres", ".urdf", lambda s, arm, _: xml.urdf(s, arm)),
        "sdf": Format("scene and arm in a world, for Gazebo", ".sdf", lambda s, arm, _: xml.sdf(s, arm)),
        "moveit": Format(
            "MoveIt's planning scene as text",
            ".scene",
            lambda s, _, shapes: problems.scene_text(s.name, primitives(shapes)),
        ),
        "ply": Format("a mesh with colors", ".ply", lambda s, _, shapes: ply(primitives(shapes))),
        "obj": Format("a mesh, an object per shape", ".obj", lambda s, _, shapes: obj(primitives(shapes))),
        "stl": Format("a mesh", ".stl", lambda s, _, shapes: stl(primitives(shapes))),
        "vamp": Format("problems for VAMP; stems stay capsules", ".vamp.json", lambda s, arm, _: problems.vamp(s, arm)),
        "robometrics": Format(
            "problems for robometrics; spheres and capsules as enclosing cylinders",
            ".robometrics.yaml",
            lambda s, arm, _: problems.robometrics(s, arm),
        ),
    }
)
"""Formats of one file each; `FOLDER_FORMAT` is a folder of pairs of files."""

FOLDER_FORMAT = "motionbenchmaker"
_TRUTH_FORMATS = ("moveit", "ply", "obj", "stl")


def export_scene(
    scene: Scene, format: str, out: str | Path, robot: str | Robot = "ur5e", truth: bool = False
) -> list[Path]:
    """Write a scene in one of the formats.

    Args:
        scene: The scene.
        format: A key of `FORMATS`, or `FOLDER_FORMAT`.
        out: Folder for the files.
        robot: Name or file of the arm, or a `Robot`.
        truth: Write the true shapes instead of the reconstructed ones; only for meshes and MoveIt's scene.

    Returns:
        The files.

    Raises:
        UnknownNameError: The format is unknown.
        InvalidValueError: The truth is requested, but the scene or the format has none.
    """
    require_choice("export format", format, [*FORMATS, FOLDER_FORMAT])
    arm, folder = get_robot(robot), Path(out)
    shapes: Shapes = scene
    if truth:
        if scene.truth is None or format not in _TRUTH_FORMATS:
            reason = "it has no truth" if scene.truth is None else f"expected one of {', '.join(_TRUTH_FORMATS)}"
            raise InvalidValueError(f"the truth of scene {scene.name!r} cannot be written as {format}: {reason}")
        shapes = scene.truth
    if format == FOLDER_FORMAT:
        return problems.motion_bench_maker(scene, arm, folder / scene.name)
    chosen = FORMATS[format]
    stem = f"{scene.name}-truth" if truth else scene.name
    return [write_atomically(folder / f"{stem}{chosen.suffix}", chosen.write(scene, arm, shapes))]
