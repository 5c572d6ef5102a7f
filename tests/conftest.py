from __future__ import annotations

import ctypes
import gc
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from greenhouse_gym.common.executors import RayExecutor
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.envs.worlds import shared_worlds
from greenhouse_gym.geometry import Box, Ellipsoid, Sphere, rotation_about
from greenhouse_gym.motion.unknown_space import _guarded
from greenhouse_gym.scene import Provenance, Scene, SceneBank, Target
from greenhouse_gym.scene.bank import _opened, write_bank
from greenhouse_gym.scene.mjcf import _spec_with_slots, _without_obstacles

# a shell that runs the tests in the background has them ignore Ctrl-C, and so would what they start
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)  # before xdist, which looks at the marks once
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give the tests of a file to one process of xdist, which makes the fixtures and caches of the file once."""
    for item in items:
        if item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(str(item.path)))


def make_scene(seed: int, stems: int = 4, row: str | None = None) -> Scene:
    """A small made-up scene: vertical stems 0.6 m from the arm, a truss in front of each, a leaf beside."""
    rng = np.random.default_rng(seed)
    tomatoes: list[Tomato] = []
    parts: list[Stem] = []
    clutter: list[Box | Sphere] = []
    for truss, y in enumerate(np.linspace(-0.6, 0.6, stems) + rng.uniform(-0.05, 0.05, stems)):
        x = 0.6 + rng.uniform(-0.03, 0.03)
        parts.append(Stem([x, y, 0.4], [x, y, 2.2], 0.006, kind="main"))
        z = rng.uniform(0.9, 1.5)
        hang = np.array([x - 0.1, y, z - 0.03])
        parts.append(Stem([x, y, z], hang, 0.002, kind="peduncle"))
        for k in range(3):
            center = hang + [0.0, 0.06 * (k - 1), -0.05 + rng.uniform(-0.01, 0.01)]
            tomatoes.append(Tomato(Sphere(center, rng.uniform(0.022, 0.028)), truss=truss, ripeness=rng.uniform()))
        clutter.append(Box([x + 0.05, y + 0.1, z + 0.25], [0.08, 0.05, 0.005], np.eye(3)))
        clutter.append(Sphere([x + 0.1, y - 0.1, z + 0.3], 0.04))
    return Scene(
        name=f"made-up-{seed}",
        tomatoes=tuple(tomatoes),
        stems=tuple(parts),
        clutter=tuple(clutter),
        targets=tuple(Target(tomato=i, difficulty="easy") for i in range(len(tomatoes))),
        provenance=Provenance(row=row or f"made-up-row-{seed}", week=0),
    )


def with_ellipsoids(scene: Scene, seed: int) -> Scene:
    """The scene with every other tomato stretched and turned."""
    rng = np.random.default_rng(seed)
    tomatoes = list(scene.tomatoes)
    for k in range(0, len(tomatoes), 2):
        axes = tomatoes[k].radius * np.array([0.8, 1.0, 1.25])
        turn = rotation_about(rng.normal(size=3), rng.uniform(0, 3))
        tomatoes[k] = replace(tomatoes[k], shape=Ellipsoid(tomatoes[k].center, axes, turn))
    return scene.model_copy(update={"tomatoes": tuple(tomatoes), "name": f"{scene.name}-ellipsoids"})


def pytest_collection_finish() -> None:
    """Keep the garbage collector from going through modules and tests again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def _caches_end_with_their_file() -> Iterator[None]:
    """Free what the package keeps for later calls, so that a process takes no more memory the more files it runs."""
    yield
    for cached in (shared_worlds, _opened, _without_obstacles, _spec_with_slots, _guarded):
        cached.cache_clear()
    gc.collect()
    if sys.platform == "linux":
        ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(scope="session")
def cluster() -> Iterator[RayExecutor]:
    """Two workers of Ray; tests that ask for it are of the group "ray", so that one process of xdist has it.

    A canceled piece of work takes its worker with it, and what came to that worker meanwhile: hence one retry.
    """
    pytest.importorskip("ray")
    with RayExecutor(workers=2, retries=1) as executor:
        yield executor


@pytest.fixture(scope="session")
def scene() -> Scene:
    return make_scene(0)


@pytest.fixture(scope="session")
def bank(tmp_path_factory: pytest.TempPathFactory) -> SceneBank:
    folder: Path = tmp_path_factory.mktemp("bank")
    splits = ["train", "train", "train", "train", "validation", "test", "test"]
    return write_bank(folder, [(make_scene(i), split) for i, split in enumerate(splits)], name="made-up")
