"""Checks of a bank: files, checksums, manifest, and every witness replayed in the simulator's model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from greenhouse_gym.errors import FileFormatError, UnknownNameError
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import planning_model
from greenhouse_gym.motion.proof import ProvingChecker
from greenhouse_gym.motion.success import is_reached
from greenhouse_gym.robots.kinematics import tool_chain, tool_state
from greenhouse_gym.scene import Scene, SceneBank, Target
from greenhouse_gym.scene.manifest import SceneEntry, target_counts
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene

STEP = 0.002
"""Largest motion of any point of the arm between two configurations of a replayed witness, metres."""

_TOLERANCE = 1e-5  # radians


def bank_faults(
    bank: str | Path | SceneBank, witnesses: bool = True, on_progress: Callable[[int], None] | None = None
) -> Iterator[str]:
    """Yield the faults of a bank, a sentence each.

    Args:
        bank: The bank.
        witnesses: True to replay the witnesses, which takes about two seconds per scene.
        on_progress: Called with the number of checked scenes.

    Raises:
        FileFormatError: The manifest is missing or damaged, is of a newer schema, or gives a row two splits.
        UnknownNameError: No such bank.
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
        if on_progress is not None:
            on_progress(done)


def _differences(entry: SceneEntry, scene: Scene) -> Iterator[str]:
    """Yield the differences between a manifest entry and its scene."""
    found = {
        "name": scene.name,
        "row": scene.provenance.row,
        "week": scene.provenance.week,
        "style": scene.provenance.style,
        "source": scene.provenance.source,
        "protocol": scene.provenance.protocol,
        "truth": None if scene.truth is None else scene.truth.count,
        "targets": target_counts(scene),
    }
    for field, value in found.items():
        listed = getattr(entry, field)
        if listed != value and not (listed is None and field in ("style", "source", "protocol", "targets", "truth")):
            yield f"{entry.name}: the manifest says {field} {listed!r}, the scene {value!r}"


def witness_faults(scene: Scene) -> Iterator[str]:
    """Yield the faults of a scene's witnesses; those for arms that are not installed are skipped."""
    compiled: dict[str, CompiledScene] = {}
    for target in scene.targets:
        label = f"{scene.name}, tomato {target.tomato} ({target.difficulty}, {target.robot})"
        if (target.witness is None) != (target.difficulty == "unreachable"):
            yield f"{label}: {'no' if target.witness is None else 'a'} witness"
        brush = None if target.brush is None else target.brush.witness
        witnesses = {"rigid": target.witness, "brush": brush}
        for leaves, witness in witnesses.items():
            if witness is None:
                continue
            try:
                known = compiled.get(target.robot) or compile_scene(scene, target.robot)
            except UnknownNameError:
                continue
            compiled[target.robot] = known
            if fault := _fault(known, target, np.array(witness), leaves):
                yield f"{label}: {fault}" + ("" if leaves == "rigid" else ", though leaves give way")


def _fault(compiled: CompiledScene, target: Target, path: Array, leaves: str) -> str:
    """Return the first fault of a witness, or an empty text."""
    robot, tomato = compiled.robot, compiled.scene.tomatoes[target.tomato]
    if path.shape[1] != len(robot.joints) or np.abs(path[0] - robot.rating_start).max() > _TOLERANCE:
        return "the witness does not begin at the start that targets are rated from"
    if ((path < robot.lower - _TOLERANCE) | (path > robot.upper + _TOLERANCE)).any():
        return "the witness leaves the joints' limits"
    if not ProvingChecker(planning_model(compiled, target.tomato, margin=0.0, leaves=leaves)).path_is_free(path, STEP):
        return "the witness touches something"
    grasp = tool_state(tool_chain(compiled.model, compiled.tip_site), path[-1:], tomato.radius).point[0]
    return "" if is_reached(float(np.linalg.norm(grasp - tomato.center))) else "the witness does not end at the tomato"
