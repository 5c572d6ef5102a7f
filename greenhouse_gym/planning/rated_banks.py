"""Banks whose scenes are rated again, for another arm or for leaves that give way; an interrupted run resumes."""

from __future__ import annotations

from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.common.files import resolved
from greenhouse_gym.errors import FileFormatError, InvalidValueError, require_seed
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.planning.certify import certify_target, shoulder_distances
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene, SceneBank, Target
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene

RATING = "rating"
"""Key in the provenance settings of a rated scene: the arm's name and checksum, the seed and the scene's checksum."""


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
    """
    opened, arm, folder = SceneBank.open(bank), get_robot(robot), new_folder(bank, out)
    if per_scene is not None and per_scene < 1:
        raise InvalidValueError(f"per_scene must be at least 1 or None, got {per_scene!r}")
    checksum = sha256(arm.path.read_bytes()).hexdigest()
    rating = {"robot": arm.name, "file_sha256": checksum, "seed": require_seed(seed), "per_scene": per_scene}
    rated: list[tuple[Scene, str]] = []
    blocked: list[str] = []
    done = 0
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


def new_folder(bank: str | Path | SceneBank, out: str | Path) -> Path:
    """Return the folder of a bank that is made from another one.

    Raises:
        InvalidValueError: It is the folder of that bank.
    """
    folder = resolved(out)
    if folder == SceneBank.open(bank).path.resolve():
        raise InvalidValueError(f"{folder}: the new bank needs another folder than the bank it is made from")
    return folder


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
