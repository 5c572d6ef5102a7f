"""Planning problems in the formats of VAMP, robometrics and MotionBenchMaker, and planning scenes of MoveIt.

Everything is in the frame of the arm's base. The target tomato is not an obstacle: the suction cup may touch it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.export.primitives import Primitive, primitives, without_capsules, without_ellipsoids
from greenhouse_gym.geometry import Array, invert, pose, quaternions_from
from greenhouse_gym.planning import goal_configurations
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import arm_pose, compile_scene

GOALS = 10
"""Goal configurations of a problem, in addition to the end of the target's witness."""

_STRING_OR_POWER = re.compile(r'"(?:[^"\\]|\\.)*"|-?\d+(?:\.\d+)?e[-+]?\d+')

FRAME = "base"


class PlanningProblem(NamedTuple):
    """A planning problem in the frame of the arm's base.

    Attributes:
        name: Name of the scene and index of the tomato.
        difficulty: Difficulty of the target.
        start: (joints,) radians.
        goals: (k, joints) radians; empty for an unreachable target.
        target: (3,) center of the tomato, metres.
        tip: (4, 4) pose of the tip at the first goal; z is the tool's axis.
        obstacles: All shapes except the target.
    """

    name: str
    difficulty: str
    start: Array
    goals: Array
    target: Array
    tip: Array
    obstacles: list[Primitive]


def problems(scene: Scene, robot: Robot) -> Iterator[PlanningProblem]:
    """Yield the problems of a scene, one for each target that is rated for the arm."""
    base_from_scene = invert(arm_pose(scene, robot))
    compiled = compile_scene(scene, robot)
    data = mujoco.MjData(compiled.model)
    shapes = [part.moved(base_from_scene) for part in primitives(scene)]
    for target in scene.targets:
        if target.robot != robot.name:
            continue
        goals = np.empty((0, len(robot.joints)))
        if target.witness is not None:
            found = goal_configurations(scene, target.tomato, robot, GOALS).configurations
            goals = np.concatenate([[target.witness[-1]], found])
            data.qpos[:] = goals[0]
            mujoco.mj_kinematics(compiled.model, data)
        tip_in_scene = pose(data.site_xmat[compiled.tip_site].reshape(3, 3), data.site_xpos[compiled.tip_site])
        tomato = shapes[target.tomato]
        others = [part for part in shapes if part is not tomato]
        name = f"{scene.name}-{target.tomato:03d}"
        yield PlanningProblem(
            name, target.difficulty, robot.rating_start, goals, tomato.position, base_from_scene @ tip_in_scene, others
        )


def vamp(scene: Scene, robot: Robot) -> bytes:
    """Return JSON for ``vamp.problem_dict_to_vamp``: spheres, boxes, and cylinders that VAMP reads as capsules.

    Stems thus stay capsules. Unreachable targets are included, with ``valid`` false.
    """
    sets = [
        {
            "problem": scene.name,
            "name": problem.name,
            "difficulty": problem.difficulty,
            "valid": len(problem.goals) > 0,
            "start": problem.start.tolist(),
            "goals": problem.goals.tolist(),
            "target": problem.target.tolist(),
            **_by_kind([without_ellipsoids(part) for part in problem.obstacles]),
        }
        for problem in problems(scene, robot)
    ]
    data = {"robot": robot.name, "joints": list(robot.joints), "problems": {scene.name: sets}}
    return (json.dumps(data) + "\n").encode()


def _by_kind(parts: Sequence[Primitive]) -> dict[str, list[dict[str, Any]]]:
    found: dict[str, list[dict[str, Any]]] = {"sphere": [], "cylinder": [], "box": []}
    for part in parts:
        named = {
            "name": part.name,
            "position": part.position.tolist(),
            "orientation_euler_xyz": part.roll_pitch_yaw.tolist(),
            "orientation_quat_xyzw": part.quaternion.tolist(),
        }
        if part.kind == "sphere":
            found["sphere"].append(named | {"radius": part.size[0]})
        elif part.kind == "box":
            found["box"].append(named | {"half_extents": list(part.size)})
        else:
            found["cylinder"].append(named | {"radius": part.size[0], "length": part.size[1]})
    return found


def robometrics(scene: Scene, robot: Robot) -> bytes:
    """Return YAML with the keys of robometrics' data sets, for reachable targets only.

    It knows cuboids and cylinders only, so spheres and capsules become their enclosing cylinders. These block a little
    free space, in the worst case that of a goal.
    """
    sets = [
        {
            "collision_buffer_ik": 0.0,
            "goal_ik": problem.goals.tolist(),
            "goal_pose": {
                "frame": "tip",
                "position_xyz": problem.tip[:3, 3].tolist(),
                "quaternion_wxyz": quaternions_from(problem.tip[:3, :3])[0].tolist(),
            },
            "obstacles": _cuboids_and_cylinders(problem.obstacles),
            "start": problem.start.tolist(),
            "world_frame": FRAME,
        }
        for problem in problems(scene, robot)
        if len(problem.goals)
    ]
    return _yaml({scene.name: sets})


def _cuboids_and_cylinders(parts: Sequence[Primitive]) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {"cuboid": {}, "cylinder": {}}
    for part in map(without_ellipsoids, parts):
        x, y, z, w = part.quaternion.tolist()
        posed = {"pose": [*part.position.tolist(), w, x, y, z]}
        if part.kind == "box":
            found["cuboid"][part.name] = posed | {"dims": [2 * half for half in part.size]}
        else:
            radius, length = (*part.size, 0.0)[:2]
            found["cylinder"][part.name] = posed | {"radius": radius, "height": length + 2 * radius}
    return found


def motion_bench_maker(scene: Scene, robot: Robot, folder: Path) -> list[Path]:
    """Write MotionBenchMaker's pairs ``scene0001.yaml`` and ``request0001.yaml``, for reachable targets only.

    Returns:
        The files, below the folder.
    """
    files = []
    reachable = (problem for problem in problems(scene, robot) if len(problem.goals))
    for number, problem in enumerate(reachable, start=1):
        request = {
            "group_name": robot.name,
            "start_state": {"joint_state": {"name": list(robot.joints), "position": problem.start.tolist()}},
            "goal_constraints": [
                {"name": problem.name, "joint_constraints": _joints(robot, goal)} for goal in problem.goals
            ],
        }
        message = scene_message(problem.name, problem.obstacles)
        files.append(write_atomically(folder / f"scene{number:04d}.yaml", _yaml(message)))
        files.append(write_atomically(folder / f"request{number:04d}.yaml", _yaml(request)))
    return files


def _joints(robot: Robot, goal: Array) -> list[dict[str, Any]]:
    return [
        {"joint_name": name, "position": value, "tolerance_above": 1e-4, "tolerance_below": 1e-4, "weight": 1.0}
        for name, value in zip(robot.joints, goal.tolist(), strict=True)
    ]


def _yaml(data: Any) -> bytes:
    """Return JSON that is also YAML.

    YAML 1.1 reads a number such as 1e-05, without a point, as a string, and no pairs of surrogates.
    """

    def rewritten(found: re.Match[str]) -> str:
        if not found[0].startswith('"'):
            return f"{float(found[0]):.12f}"
        text = json.loads(found[0])
        return '"' + "".join(each if each > "\uffff" else json.dumps(each)[1:-1] for each in text) + '"'

    return (_STRING_OR_POWER.sub(rewritten, json.dumps(data)) + "\n").encode()


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
