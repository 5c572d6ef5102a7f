"""MoveIt's planning scene: the text format of its RViz panel, and a message."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from greenhouse_gym.export.primitives import Primitive, without_capsules, without_ellipsoids

FRAME = "base"


def scene_text(name: str, parts: Iterable[Primitive]) -> bytes:
    """Return a scene in the first version of the ``.scene`` format, which every MoveIt reads.

    Each shape is one object; a capsule becomes a cylinder and two spheres, an ellipsoid its enclosing sphere.
    """
    lines = [name]
    for part in parts:
        pieces = list(without_capsules(without_ellipsoids(part)))
        lines += [f"* {part.name}", str(len(pieces))]
        for piece in pieces:
            size = 2 * np.array(piece.size) if piece.kind == "box" else np.array(piece.size)
            lines += [piece.kind, _row(size), _row(piece.position), _row(piece.quaternion), _row((*piece.color, 1.0))]
    return ("\n".join([*lines, "."]) + "\n").encode()


def _row(values: Iterable[float]) -> str:
    return " ".join(f"{float(value) + 0.0:.6g}" for value in values)


def scene_message(name: str, parts: Iterable[Primitive]) -> dict[str, Any]:
    """Return a ``moveit_msgs/PlanningScene`` as in MotionBenchMaker's YAML files."""
    return {"name": name, "world": {"collision_objects": [_object(part) for part in parts]}}


def _object(part: Primitive) -> dict[str, Any]:
    pieces = list(without_capsules(without_ellipsoids(part)))
    return {
        "header": {"frame_id": FRAME},
        "id": part.name,
        "primitives": [{"type": piece.kind, "dimensions": _dimensions(piece)} for piece in pieces],
        "primitive_poses": [
            {"position": piece.position.tolist(), "orientation": piece.quaternion.tolist()} for piece in pieces
        ],
    }


def _dimensions(piece: Primitive) -> list[float]:
    """Return the dimensions of ``shape_msgs/SolidPrimitive``: sides; radius; height and radius of a cylinder."""
    if piece.kind == "box":
        return [2 * half for half in piece.size]
    return list(reversed(piece.size))
