"""A bank rated for another arm: the same scenes, with targets that carry that arm's difficulties and witnesses."""

from __future__ import annotations

from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.errors import FileFormatError, InvalidValueError, require_seed
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.planning.certify import certify_target
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene, SceneBank, Target
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene

RATING = "rating"
"""Under this name a rated scene's provenance settings say for which arm, by name and checksum, and with which seed."""


def rate_bank(
    bank: str | Path | SceneBank,
    robot: str | Path | Robot,
    out: str | Path,
    seed: int = 0,
    per_scene: int | None = None,
    on_target: Callable[[int], None] | None = None,
) -> SceneBank:
    """Rate the tomatoes of a bank as targets of an arm and write the bank anew, beside the old one.

    Targets rated for other arms stay. Scenes are written as they are finished and the manifest last, so what was
    interrupted goes on with the scenes that are missing; one that was rated for another arm, from another scene or with
    another seed is rated anew.

    Args:
        bank: The bank.
        robot: Name or file of the arm, or a `Robot`.
        out: Folder of the new bank, another than the old one's.
        seed: Same seed, same ratings.
        per_scene: How many tomatoes of each scene to rate, those nearest to the arm's shoulder; all when left out.
        on_target: Told how many of the tomatoes are rated, those of finished scenes among them.

    Raises:
        InvalidValueError: ``out`` is the bank's own folder, or the arm touches something at its start in every scene.
    """
    opened, arm, folder = SceneBank.open(bank), get_robot(robot), Path(out).resolve()
    if folder == opened.path.resolve():
        raise InvalidValueError(
            f"{folder}: the rated bank needs a folder of its own, not that of the bank it is made of"
        )
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
        made = _finished(folder / f"{name}.json", source)
        if made is None:
            compiled = compile_scene(scene, arm)
            touching = _touching(compiled)
            if touching:
                blocked.append(f"{name} ({touching})")
            mine: list[Target] = []
            for tomato in _nearest(scene, per_scene):
                mine.append(certify_target(compiled, tomato, seed))
                if on_target is not None:
                    on_target(done + len(mine))
            made = _with_targets(scene, mine, source)
            made.save(folder / f"{name}.json")
        done += len(_nearest(scene, per_scene))
        rated.append((made, opened.split_of(name)))
    if blocked and len(blocked) == len(rated):
        raise InvalidValueError(f"{arm.name} touches something at its start in every scene: {', '.join(blocked)}")
    return write_bank(folder, rated, folder.name, f"{opened.manifest.name}, rated for {arm.name}")


def _nearest(scene: Scene, count: int | None) -> list[int]:
    """Indices of the tomatoes to rate."""
    shoulder = scene.placement.position + [0.0, 0.0, scene.placement.shoulder_height]
    distances = [np.linalg.norm(tomato.center - shoulder) for tomato in scene.tomatoes]
    return sorted(np.argsort(distances, kind="stable")[:count].tolist())


def _finished(path: Path, source: dict[str, Any]) -> Scene | None:
    """The scene in a file, if it was rated as is asked for."""
    try:
        scene = Scene.load(path)
    except FileFormatError:
        return None
    return scene if scene.provenance.settings.get(RATING) == source else None


def _with_targets(scene: Scene, mine: list[Target], source: dict[str, Any]) -> Scene:
    others = [target for target in scene.targets if target.robot != source["robot"]]
    settings = {**scene.provenance.settings, RATING: source}
    provenance = scene.provenance.model_copy(update={"settings": settings})
    return scene.model_copy(update={"targets": (*others, *mine), "provenance": provenance})


def _touching(compiled: CompiledScene) -> str:
    """What the arm touches at its start in a scene with tomatoes, or nothing."""
    if not compiled.scene.tomatoes:
        return ""
    checker = CollisionChecker(planning_model(compiled, 0))
    return ", ".join(f"{a} with {b}" for a, b in checker.contacts(compiled.robot.start)[:1])
