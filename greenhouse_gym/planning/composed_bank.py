"""Bank of any number of training scenes, each composed when it is first used."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.errors import InvalidValueError, check_whole, require_seed
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.planning.certify import certify_targets
from greenhouse_gym.planning.rated_banks import load_rated, new_folder, with_source
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene, SceneBank, compile_scene
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.composition import Plant, composed_scene, plants_of
from greenhouse_gym.scene.manifest import SceneEntry, Split, make_manifest

SPLIT: Split = "train"
"""Split of the scenes of a `ComposedBank`, and of the scenes that give their plants."""

COMPOSITION = "composition"
"""Key of the source of a composed scene in the settings of its provenance."""

_ATTEMPTS = 100


class ComposedBank(SceneBank):
    """Training scenes composed of the plants of a bank's training scenes, about a second of computing each.

    Scene i depends on the bank, the seed and i alone. Its row is new (`greenhouse_gym.scene.composition`), its targets
    are rated by `certify_targets`, and the arm's starts are free. Pass it as ``bank=``: an environment of the MuJoCo
    backend draws from a few scenes at a time and composes the next one when it needs it. The Warp backend composes all
    of them first, so give it a bank of some hundreds, or write them with ``greenhouse-gym bank compose``.

    Args:
        source: Bank that gives the plants: name, folder or `SceneBank`, for example a selection.
        count: Number of scenes.
        seed: Seed.
        robot: The arm.
        targets: Number of tomatoes to rate in each scene.

    Raises:
        InvalidValueError: The bank has no training scene with a complete plant.
    """

    def __init__(
        self,
        source: str | Path | SceneBank = "default",
        count: int = 10_000,
        seed: int = 0,
        robot: str | Path | Robot = "ur5e",
        targets: int = 10,
    ):
        self._source, self._robot = SceneBank.open(source), get_robot(robot)
        self._seed, self._targets = require_seed(seed), check_whole("targets", targets, 1)
        count = check_whole("count", count, 1)
        self._plant_kinds: list[tuple[str | None, str | None]] = []  # source and style of each scene
        self._bases, self._donors = defaultdict[Any, list[str]](list), defaultdict[Any, list[list[Plant]]](list)
        for entry in self._source.manifest.scenes:
            if entry.split == SPLIT and (plants := plants_of(self._source.scene(entry.name))):
                kind = entry.source, entry.style
                self._plant_kinds.append(kind)
                self._bases[kind].append(entry.name)
                self._donors[kind].append(plants)
        if not self._plant_kinds:
            raise InvalidValueError(f"bank {self._source.path} has no training scene with a complete plant")
        counts = [self._source.scene(name).count for names in self._bases.values() for name in names]
        self._largest = max(counts)
        name = f"{self._source.manifest.name}-composed"
        entries = (f"{name}-{self._seed}-{i:06}" for i in range(count))
        described = f"Composed with seed {self._seed} of {self._source.manifest.name}, {self._source.sha256}."
        manifest = make_manifest(
            name,
            described,
            tuple(SceneEntry(e, "", "", e, None, SPLIT, self._largest) for e in entries),
            self._source.path,
        )
        super().__init__(self._source.path, manifest)

    def __reduce__(self) -> tuple[Callable[..., ComposedBank], tuple[Any, ...]]:
        return ComposedBank, (self._source, len(self), self._seed, self._robot, self._targets)

    def write(self, out: str | Path, on_progress: Callable[[int], None] = lambda done: None) -> SceneBank:
        """Write the scenes as a bank, each as soon as it is composed, so that an interrupted run resumes.

        Args:
            out: Folder of the new bank; not that of its source.
            on_progress: Called with the number of scenes so far.

        Raises:
            InvalidValueError: ``out`` is the folder of the source.
            FileWriteError: It cannot be written, or another process writes it.
        """
        source = {
            "bank_sha256": self._source.sha256,
            "robot_sha256": sha256(self._robot.path.read_bytes()).hexdigest(),
            "seed": self._seed,
            "targets": self._targets,
        }
        made: list[tuple[Scene, str]] = []
        with new_folder(self._source, out) as folder:
            for name in self.names():
                scene = load_rated(folder / f"{name}.json", source, COMPOSITION)
                if scene is None:
                    scene = with_source(self.scene(name), source, COMPOSITION)
                    scene.save(folder / f"{name}.json")
                made.append((scene, SPLIT))
                on_progress(len(made))
            return write_bank(folder, made, folder.name, self.manifest.description)

    def _read(self, entry: SceneEntry) -> Scene:
        """Compose a scene.

        Raises:
            InvalidValueError: No attempt gave a stand in which the arm starts free and reaches a tomato.
        """
        rng = np.random.default_rng([self._seed, int(entry.name.rpartition("-")[2])])
        kind = self._plant_kinds[int(rng.integers(len(self._plant_kinds)))]
        bases, donors = self._bases[kind], self._donors[kind]

        def draw() -> Plant:
            plants = donors[int(rng.integers(len(donors)))]
            return plants[int(rng.integers(len(plants)))]

        for _ in range(_ATTEMPTS):
            base = self._source.scene(bases[int(rng.integers(len(bases)))])
            scene = composed_scene(base, draw, rng, entry.name, self._largest)
            if not scene.tomatoes or not _starts_free(scene, self._robot):
                continue
            targets = certify_targets(scene, self._robot, max_targets=self._targets)
            if any(target.witness for target in targets):
                return scene.model_copy(update={"targets": targets})
        raise InvalidValueError(f"{entry.name}: the arm {self._robot.name} starts free in none of {_ATTEMPTS} stands")


def _starts_free(scene: Scene, robot: Robot) -> bool:
    """Return whether the arm touches nothing at its start and at the start of ratings."""
    checker = CollisionChecker(planning_model(compile_scene(scene, robot), 0))
    return not any(checker.contacts(start) for start in (robot.start, robot.rating_start))
