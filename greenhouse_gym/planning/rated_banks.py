"""Banks whose scenes are rated again, for another arm or for leaves that give way; an interrupted run resumes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.common.files import exclusive, resolved
from greenhouse_gym.errors import FileFormatError, InvalidValueError, require_seed
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.motion.leaf_contacts import LeafContacts
from greenhouse_gym.motion.proof import ProvingChecker
from greenhouse_gym.planning.certify import MAX_CHECKS, certify_target, shortest_free, shoulder_distances
from greenhouse_gym.planning.query import plan
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene, SceneBank, Target
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene
from greenhouse_gym.scene.scene import BrushCertificate

RATING = "rating"
"""Key in the provenance settings of a rated scene: the arm's name and checksum, the seed and the scene's checksum."""

BRUSH_RATING = "brush_rating"
"""Key in the provenance settings of a rated scene: the arm's name, the seed and the scene's checksum."""


def rate_bank(
    bank: str | Path | SceneBank,
    robot: str | Path | Robot,
    out: str | Path,
    seed: int = 0,
    per_scene: int | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> SceneBank:
    """Rate the tomatoes of a bank for an arm and write a new bank with these targets.

    Targets for other arms are kept. Each scene is written when it is finished and the manifest last, so an interrupted
    run resumes; scenes rated for another arm, from another scene or with another seed are rated again.

    Args:
        bank: The bank.
        robot: Name or file of the arm, or a `Robot`.
        out: Folder of the new bank; not that of the old one.
        seed: Same seed, same ratings.
        per_scene: Number of tomatoes to rate in each scene, those nearest to the arm's shoulder; None for all.
        on_progress: Called with the number of rated tomatoes, including those of scenes finished earlier.

    Raises:
        InvalidValueError: ``out`` is the bank's own folder, or the arm's start is in collision in every scene.
        FileWriteError: ``out`` cannot be written, or another process is at work in it.
    """
    opened, arm = SceneBank.open(bank), get_robot(robot)
    if per_scene is not None and per_scene < 1:
        raise InvalidValueError(f"per_scene must be at least 1 or None, got {per_scene!r}")
    checksum = sha256(arm.path.read_bytes()).hexdigest()
    rating = {"robot": arm.name, "file_sha256": checksum, "seed": require_seed(seed), "per_scene": per_scene}
    rated: list[tuple[Scene, str]] = []
    blocked: list[str] = []
    done = 0
    with new_folder(bank, out) as folder:
        for name in opened.names():
            scene = opened.scene(name)
            source = {**rating, "scene_sha256": sha256(scene.model_dump_json().encode()).hexdigest()}
            result = load_rated(folder / f"{name}.json", source)
            if result is None:
                compiled = compile_scene(scene, arm)
                contacts = _start_contacts(compiled)
                if contacts:
                    blocked.append(f"{name} ({contacts})")
                targets: list[Target] = []
                for tomato in _nearest(scene, per_scene):
                    targets.append(certify_target(compiled, tomato, seed))
                    if on_progress is not None:
                        on_progress(done + len(targets))
                result = _with_targets(scene, targets, source)
                result.save(folder / f"{name}.json")
            done += len(_nearest(scene, per_scene))
            rated.append((result, opened.split_of(name)))
        if blocked and len(blocked) == len(rated):
            raise InvalidValueError(f"{arm.name} touches something at its start in every scene: {', '.join(blocked)}")
        return write_bank(folder, rated, folder.name, f"{opened.manifest.name}, rated for {arm.name}")


def _nearest(scene: Scene, count: int | None) -> list[int]:
    """Return the indices of the tomatoes nearest to the shoulder."""
    return sorted(np.argsort(shoulder_distances(scene), kind="stable")[:count].tolist())


@contextmanager
def new_folder(bank: str | Path | SceneBank, out: str | Path) -> Iterator[Path]:
    """Lock the folder of a bank that is made from another one, for this process, and yield it.

    Raises:
        InvalidValueError: It is the folder of that bank.
        FileWriteError: It cannot be written, or another process is at work in it.
    """
    folder = resolved(out)
    if folder == SceneBank.open(bank).path.resolve():
        raise InvalidValueError(f"{folder}: the new bank needs another folder than the bank it is made from")
    with exclusive(folder):
        yield folder


def load_rated(path: Path, source: dict[str, Any], key: str = RATING) -> Scene | None:
    """Load a scene if it exists and was rated from this source; ``key`` is that of the rating."""
    try:
        scene = Scene.load(path)
    except FileFormatError:
        return None
    return scene if scene.provenance.settings.get(key) == source else None


def _with_targets(scene: Scene, targets: list[Target], source: dict[str, Any]) -> Scene:
    others = [target for target in scene.targets if target.robot != source["robot"]]
    return with_source(scene.model_copy(update={"targets": (*others, *targets)}), source, RATING)


def with_source(scene: Scene, source: dict[str, Any], key: str) -> Scene:
    """Return a scene whose provenance holds the source of a rating, or of the scene itself, under a key."""
    settings = {**scene.provenance.settings, key: source}
    return scene.model_copy(update={"provenance": scene.provenance.model_copy(update={"settings": settings})})


def _start_contacts(compiled: CompiledScene) -> str:
    """Return a contact of the arm at its start, or an empty text; a scene without tomatoes is not checked."""
    if not compiled.scene.tomatoes:
        return ""
    contacts = CollisionChecker(planning_model(compiled, 0)).contacts(compiled.robot.rating_start)
    return ", ".join(f"{compiled.geom_name(a)} with {compiled.geom_name(b)}" for a, b in contacts[:1])


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
