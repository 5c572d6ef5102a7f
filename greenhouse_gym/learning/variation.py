"""Varied scenes for training: mirrored, shifted, with moved plants and some fruit and clutter removed.

A variation is a plausible row, no more: its tomatoes keep the ratings of their scene, although it is not known whether
they can still be reached.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.geometry.shapes import mirrored
from greenhouse_gym.scene import Scene, SceneBank, Target
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.plant_motion import move_plants

LIVELY = PlantMotion(truss_turn=0.4, truss_swing=0.15, stem_shift=0.02, leaf_shift=0.03)
"""Motion of plants, several times that of real ones."""


@dataclass(frozen=True)
class Variation:
    """Limits of the difference between a variation and its scene.

    Attributes:
        plants: Motion of the plants.
        shift: Largest shift of everything along x, y and z, metres.
        thinning: Largest fraction of tomatoes, and of clutter, that is removed.
        mirrored: True to mirror half of the variations along the row.
    """

    plants: PlantMotion = LIVELY
    shift: tuple[float, float, float] = (0.03, 0.2, 0.06)
    thinning: float = 0.25
    mirrored: bool = True


def varied_scene(scene: Scene, rng: np.random.Generator, name: str, variation: Variation | None = None) -> Scene:
    """Sample a variation of a scene; its targets are the remaining ones, without witnesses."""
    variation = variation or Variation()
    plants = move_plants(scene, variation.plants, rng)
    flip = np.array([1.0, -1.0 if variation.mirrored and rng.random() < 0.5 else 1.0, 1.0])
    shift = rng.uniform(-1.0, 1.0, 3) * variation.shift
    tomatoes = _subset(len(plants.tomatoes), variation.thinning, rng)
    clutter = _subset(len(plants.clutter), variation.thinning, rng)
    index = {int(old): new for new, old in enumerate(tomatoes)}
    targets = (
        Target(tomato=index[t.tomato], difficulty=t.difficulty, robot=t.robot)
        for t in scene.targets
        if t.tomato in index and t.difficulty != "unreachable"
    )
    parts = {
        "tomatoes": tuple(
            replace(tomato, shape=mirrored(tomato.shape, flip, shift))
            for tomato in (plants.tomatoes[k] for k in tomatoes)
        ),
        "stems": tuple(mirrored(stem, flip, shift) for stem in plants.stems),
        "clutter": tuple(mirrored(plants.clutter[k], flip, shift) for k in clutter),
        "targets": tuple(targets),
    }
    return scene.model_copy(update={**parts, "name": name, "truth": None, "occupancy": None})


def varied_bank(
    bank: SceneBank, folder: str | Path, count: int, seed: int = 0, variation: Variation | None = None
) -> SceneBank:
    """Write a bank with a bank's scenes and ``count`` variations of its training scenes, evenly many of each.

    The other splits are unchanged, so policies trained on the bank can be validated on it.
    """

    def scenes() -> Iterator[tuple[Scene, str]]:
        train = bank.names("train")
        for name in bank.names():
            yield bank.scene(name), bank.split_of(name)
        for k in range(count):
            source = bank.scene(train[k % len(train)])
            rng = np.random.default_rng([seed, k])
            yield varied_scene(source, rng, f"{source.name}-varied-{k}", variation), "train"

    return write_bank(folder, scenes(), "varied", "Scenes and variations of them, to train on.")


def _subset(count: int, thinning: float, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    return np.flatnonzero(rng.random(count) >= rng.uniform(0.0, thinning))
