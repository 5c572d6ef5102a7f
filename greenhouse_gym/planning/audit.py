"""Is a bank whole: files, checksums, what the manifest says, and every witness replayed in the simulator's world."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from greenhouse_gym.errors import FileFormatError, UnknownNameError
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import planning_model
from greenhouse_gym.motion.proof import ProvingChecker
from greenhouse_gym.robots.kinematics import tool_chain, tool_state
from greenhouse_gym.scene import Scene, SceneBank, Target
from greenhouse_gym.scene.manifest import SceneEntry, target_counts
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene

STEP = 0.002
"""Metres that a point of the arm moves at most from one configuration of a replayed witness to the next."""

_AT_GOAL = 0.02  # metres, the radius of success
_SAME = 1e-5  # radians


def faults_of(
    bank: str | Path | SceneBank, witnesses: bool = True, on_scene: Callable[[int], None] | None = None
) -> Iterator[str]:
    """What is wrong with a bank, a sentence each; none if it is whole.

    Args:
        bank: The bank.
        witnesses: Replay them: about two seconds a scene.
        on_scene: Told how many scenes are done.

    Raises:
        FileFormatError: The manifest is missing or damaged, is of a newer schema, or gives a row two splits.
        UnknownNameError: There is no such bank.
    """
    opened = SceneBank.open(bank)
    for done, entry in enumerate(opened.manifest.scenes, start=1):
        try:
            scene = opened.scene(entry.name)
        except FileFormatError as error:
            yield str(error)
        else:
            yield from _differences(entry, scene)
            if witnesses:
                yield from witness_faults(scene)
        if on_scene is not None:
            on_scene(done)


def _differences(entry: SceneEntry, scene: Scene) -> Iterator[str]:
    """Where the manifest says something else than the scene."""
    found = {
        "name": scene.name,
        "row": scene.provenance.row,
        "week": scene.provenance.week,
        "style": scene.provenance.style,
        "source": scene.provenance.source,
        "protocol": scene.provenance.protocol,
        "truth": None if scene.truth is None else len(scene.truth.obstacles),
        "targets": target_counts(scene),
    }
    for field, value in found.items():
        said = getattr(entry, field)
        if said != value and not (said is None and field in ("style", "source", "protocol", "targets", "truth")):
            yield f"{entry.name}: the manifest says {field} {said!r}, the scene {value!r}"


def witness_faults(scene: Scene) -> Iterator[str]:
    """What is wrong with the witnesses of a scene; those for arms whose files are not here are left out."""
    compiled: dict[str, CompiledScene] = {}
    for target in scene.targets:
        where = f"{scene.name}, tomato {target.tomato} ({target.difficulty}, {target.robot})"
        if (target.witness is None) != (target.difficulty == "unreachable"):
            yield f"{where}: {'no' if target.witness is None else 'a'} witness"
        elif target.witness is not None:
            try:
                known = compiled.get(target.robot) or compile_scene(scene, target.robot)
            except UnknownNameError:
                continue
            compiled[target.robot] = known
            if fault := _fault(known, target, np.array(target.witness)):
                yield f"{where}: {fault}"


def _fault(compiled: CompiledScene, target: Target, path: Array) -> str:
    """What is wrong with one witness, or nothing."""
    robot, tomato = compiled.robot, compiled.scene.tomatoes[target.tomato]
    if path.shape[1] != len(robot.joints) or np.abs(path[0] - robot.start).max() > _SAME:
        return "the witness does not begin at the arm's start"
    if ((path < robot.lower - _SAME) | (path > robot.upper + _SAME)).any():
        return "the witness leaves the joints' limits"
    if not ProvingChecker(planning_model(compiled, target.tomato, margin=0.0)).path_is_free(path, STEP):
        return "the witness touches something"
    grasp = tool_state(tool_chain(compiled.model, compiled.tip_site), path[-1:], tomato.radius).point[0]
    return "" if np.linalg.norm(grasp - tomato.center) <= _AT_GOAL else "the witness does not end at the tomato"
