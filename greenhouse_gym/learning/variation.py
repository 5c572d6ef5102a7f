"""More scenes to train on out of a bank's: mirrored, shifted, with plants that moved and fruit and leaves taken away.

No row is reconstructed for them. What a variation shows could stand in a row, and that is all that is claimed: whether
a tomato can still be reached is not known, and its rating is that of the scene it comes from.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.geometry import Array, Capsule, Sphere
from greenhouse_gym.geometry.shapes import AnyShape
from greenhouse_gym.scene import Scene, SceneBank, Target
from greenhouse_gym.scene.bank import write_bank
from greenhouse_gym.scene.plant_motion import move_plants

LIVELY = PlantMotion(truss_turn=0.4, truss_swing=0.15, stem_shift=0.02, leaf_shift=0.03)
"""Plants that moved several times as far as real ones do."""


@dataclass(frozen=True)
class Variation:
    """How far a variation may be from its scene.

    Attributes:
        plants: How far the plants have moved.
        shift: Largest shift of everything along x, y and z, metres.
        thinning: Largest share of tomatoes, and of clutter, that is taken away.
        mirrored: Whether half of the variations are mirrored along the row.
    """

    plants: PlantMotion = LIVELY
    shift: tuple[float, float, float] = (0.03, 0.2, 0.06)
    thinning: float = 0.25
    mirrored: bool = True


def varied_scene(scene: Scene, random: np.random.Generator, name: str, variation: Variation | None = None) -> Scene:
    """A variation of a scene; its targets are those that are left, without a path that proves them."""
    variation = variation or Variation()
    plants = move_plants(scene, variation.plants, random)
    flip = np.array([1.0, -1.0 if variation.mirrored and random.random() < 0.5 else 1.0, 1.0])
    shift = random.uniform(-1.0, 1.0, 3) * variation.shift
    kept = _kept(len(plants.tomatoes), variation.thinning, random)
    clutter = _kept(len(plants.clutter), variation.thinning, random)
    place = {int(old): new for new, old in enumerate(kept)}
    targets = (
        Target(tomato=place[t.tomato], difficulty=t.difficulty, robot=t.robot)
        for t in scene.targets
        if t.tomato in place and t.difficulty != "unreachable"
    )
    parts = {
        "tomatoes": tuple(
            replace(tomato, shape=_placed(tomato.shape, flip, shift)) for tomato in (plants.tomatoes[k] for k in kept)
        ),
        "stems": tuple(_placed(stem, flip, shift) for stem in plants.stems),
        "clutter": tuple(_placed(plants.clutter[k], flip, shift) for k in clutter),
        "targets": tuple(targets),
    }
    return scene.model_copy(update={**parts, "name": name, "truth": None, "occupancy": None})


def varied_bank(
    bank: SceneBank, folder: str | Path, count: int, seed: int = 0, variation: Variation | None = None
) -> SceneBank:
    """Write a bank of a bank's training scenes and ``count`` variations of them, as equally many of each as can be.

    The other splits come along unchanged, so that the bank can judge what is trained on it.
    """

    def scenes() -> Iterator[tuple[Scene, str]]:
        train = bank.names("train")
        for name in bank.names():
            yield bank.scene(name), bank.split_of(name)
        for k in range(count):
            source = bank.scene(train[k % len(train)])
            random = np.random.default_rng([seed, k])
            yield varied_scene(source, random, f"{source.name}-varied-{k}", variation), "train"

    return write_bank(folder, scenes(), "varied", "Scenes and variations of them, to train on.")


def _kept(count: int, thinning: float, random: np.random.Generator) -> npt.NDArray[np.int64]:
    return np.flatnonzero(random.random(count) >= random.uniform(0.0, thinning))


def _placed(shape: AnyShape, flip: Array, shift: Array) -> AnyShape:
    """A shape, mirrored and shifted."""
    if isinstance(shape, Capsule):
        return replace(shape, start=shape.start * flip + shift, end=shape.end * flip + shift)
    center = shape.center * flip + shift
    if isinstance(shape, Sphere):
        return replace(shape, center=center)
    # a box or an ellipsoid is its own mirror image, so mirroring its frame on both sides leaves a rotation
    return replace(shape, center=center, rotation=shape.rotation * np.outer(flip, flip))
