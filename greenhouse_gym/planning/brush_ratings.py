"""Certificates for targets with leaves that give way: which "unreachable" tomatoes are merely behind leaves."""

from __future__ import annotations

from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

import numpy as np

from greenhouse_gym.errors import require_seed
from greenhouse_gym.motion.collision import planning_model
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.motion.leaf_contacts import LeafContacts
from greenhouse_gym.motion.proof import ProvingChecker
from greenhouse_gym.planning.certify import MAX_CHECKS, certify_target, shortest_free
from greenhouse_gym.planning.query import plan
from greenhouse_gym.planning.rated_banks import load_rated, new_folder, with_source
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene, SceneBank, Target
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene
from greenhouse_gym.scene.scene import BrushCertificate

BRUSH_RATING = "brush_rating"
"""Key in the provenance settings of a rated scene: the arm's name, the seed and the scene's checksum."""


def with_brush_certificates(scene: Scene, robot: str | Robot = "ur5e", seed: int = 0) -> Scene:
    """Return a scene whose targets for an arm are also rated with leaves that give way, see `Target.brush`.

    A target that is reached without touching a leaf keeps its rating. For the others, the rule of
    `greenhouse_gym.planning.certify` applies without the leaves, and the witness is a path through few of them.

    Args:
        scene: A scene with targets; those for other arms stay as they are.
        robot: Name or file of the arm, or a `Robot`.
        seed: Same seed, same result.
    """
    arm = get_robot(robot)
    compiled = compile_scene(scene, arm)
    targets = [
        target
        if target.robot != arm.name
        else target.model_copy(update={"brush": _certificate(compiled, scene, target, seed)})
        for target in scene.targets
    ]
    return scene.model_copy(update={"targets": tuple(targets)})


def _certificate(compiled: CompiledScene, scene: Scene, target: Target, seed: int) -> BrushCertificate:
    """Rate a target with leaves that give way."""
    if target.witness is not None:  # the path touches nothing
        return BrushCertificate(difficulty=target.difficulty)
    free = certify_target(compiled, target.tomato, seed, "brush")
    if free.witness is None:
        return BrushCertificate(difficulty=free.difficulty)
    robot, start, contacts = compiled.robot, compiled.robot.rating_start, LeafContacts(compiled)
    planned = plan(
        scene, target.tomato, robot, time_limit=None, max_checks=MAX_CHECKS, seed=seed, start=start, leaves="brush"
    )
    checker = ProvingChecker(planning_model(compiled, target.tomato, leaves="brush"), arm_reaches(robot))
    shortest = shortest_free(checker, robot, [planned])
    paths = [path for path in (shortest, np.array(free.witness)) if path is not None]
    leaves = [len(contacts.brushed(path)) for path in paths]
    best = int(np.argmin(leaves))
    witness = tuple(tuple(configuration) for configuration in paths[best].tolist())
    return BrushCertificate(difficulty=free.difficulty, witness=witness, leaves=leaves[best])


def brush_bank(
    bank: str | Path | SceneBank,
    out: str | Path,
    robot: str | Path | Robot = "ur5e",
    seed: int = 0,
    on_progress: Callable[[int], None] | None = None,
) -> SceneBank:
    """Write a copy of a bank whose targets for an arm are also rated with leaves that give way.

    Args:
        bank: The bank.
        out: Folder of the new bank; not that of the old one. Scenes that are there already are not rated again, so an
            interrupted run resumes.
        robot: Name or file of the arm, or a `Robot`.
        seed: Same seed, same ratings.
        on_progress: Called with the number of finished scenes.

    Raises:
        InvalidValueError: ``out`` is the bank's own folder.
        FileWriteError: It cannot be written, or another process is at work in it.
    """
    opened, arm, seed = SceneBank.open(bank), get_robot(robot), require_seed(seed)
    rated: list[tuple[Scene, str]] = []
    with new_folder(bank, out) as folder:
        for name in opened.names():
            scene, path = opened.scene(name), folder / f"{name}.json"
            source = {
                "robot": arm.name,
                "seed": seed,
                "scene_sha256": sha256(scene.model_dump_json().encode()).hexdigest(),
            }
            result = load_rated(path, source, BRUSH_RATING)
            if result is None:
                result = with_source(with_brush_certificates(scene, arm, seed), source, BRUSH_RATING)
                result.save(path)
            rated.append((result, opened.split_of(name)))
            if on_progress is not None:
                on_progress(len(rated))
        return write_bank(folder, rated, folder.name, f"{opened.manifest.name}, rated with leaves that give way")
