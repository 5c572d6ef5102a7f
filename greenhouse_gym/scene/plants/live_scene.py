"""Scene to plan in, made of the plants of a running simulation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from greenhouse_gym.geometry import Array, Box, pose, transformed
from greenhouse_gym.scene import CompiledScene, Scene
from greenhouse_gym.scene.plants.live import LivePlants
from greenhouse_gym.scene.plants.states import HANGING, WAITING

_AT_REST = 2e-4  # metres and radians by which an organ may have moved and still be where it was scanned


class LiveScene(NamedTuple):
    """Scene with its plants in their current poses.

    Attributes:
        scene: The scene, with the crate; fruit that came off are left out.
        tomatoes: Index in it of each fruit that hangs, by its number among those that can come off.
    """

    scene: Scene
    tomatoes: dict[int, int]


def live_scene(plants: LivePlants, compiled: CompiledScene, leaves: bool, around_crate: float = 0.0) -> LiveScene:
    """Return the true scene with the plants in their current poses.

    Args:
        plants: The plants.
        compiled: The simulated scene.
        leaves: Whether the leaves that give way are obstacles. Other leaves let the arm pass and are left out.
        around_crate: Distance by which the walls of the crate are thickened, metres.
    """
    scene, planted, data = compiled.scene, plants.planted, plants.data
    assert isinstance(scene, Scene)
    shapes: list[Any] = [*scene.tomatoes, *scene.stems, *scene.clutter]
    for row, motion in motions(plants).items():
        shapes[row] = _moved(shapes[row], motion)
    state = dict(zip(planted.fruit.ravel().tolist(), plants.state.tolist(), strict=True))
    gone: set[int] = set()
    for truss, cut in zip(planted.trusses, plants.cut, strict=False):
        gone.update(truss.rows if cut else ())
        for fruit in truss.fruit:
            if cut or state.get(fruit.row, HANGING) not in (HANGING, WAITING):
                gone.update((fruit.row, *fruit.pedicel))
    kept = {row for leaf in plants.leaves if leaves for row in (*leaf.rows, *leaf.plates)} | {*planted.topology.fixed}
    tomatoes, stems = len(scene.tomatoes), len(scene.stems)
    left = [row for row in range(tomatoes) if row not in gone]
    turn, at = data.xmat[planted.ids.crate].reshape(3, 3), data.xpos[planted.ids.crate]
    crate = [Box(turn @ middle + at, half + around_crate, turn) for middle, half in plants.crate.boxes]
    parts = {
        "tomatoes": tuple(shapes[row] for row in left),
        "stems": tuple(shapes[row] for row in range(tomatoes, tomatoes + stems) if row not in gone),
        "clutter": (*(shapes[row] for row in sorted(kept)), *crate),
    }
    indices = {row: k for k, row in enumerate(left)}
    hanging = {k: indices[row] for k, row in enumerate(planted.fruit.ravel().tolist()) if row in indices}
    return LiveScene(scene.model_copy(update={**parts, "targets": (), "truth": None, "occupancy": None}), hanging)


def motions(plants: LivePlants) -> dict[int, Array]:
    """Return the motions (4, 4) since the scan of the shapes that have moved, by their rows, without loose fruit."""
    planted, model, data, result = plants.planted, plants.model, plants.data, dict(plants.motions)

    def move(rows: Sequence[int], body: int, origin: Array) -> None:
        moved = pose(data.xmat[body].reshape(3, 3), data.xpos[body]) @ pose(np.eye(3), -origin)
        if np.abs(moved - np.eye(4)).max() >= _AT_REST:
            result.update({row: moved @ result.get(row, np.eye(4)) for row in rows})

    for slot, truss in enumerate(plants.seated.tolist()):
        if truss < 0 or plants.cut[truss]:
            continue
        body, organ = int(planted.ids.truss[slot]), planted.trusses[truss]
        live, attached = planted.split(truss)
        move(organ.rows, body, organ.root)
        for fruit in attached:
            move((fruit.row, *fruit.pedicel, *fruit.calyx), body, organ.root)
        for own, fruit in zip(planted.ids.fruit[slot].tolist(), live, strict=False):
            move((fruit.row, *fruit.pedicel, *fruit.calyx), own, organ.root + model.body_pos[own])
    for body, leaf in zip(planted.ids.leaf.tolist(), plants.leaves, strict=False):
        move((*leaf.rows, *leaf.plates), body, leaf.root)
    return result


def _moved(shape: Any, moved: Array) -> Any:
    return shape.transformed(moved) if hasattr(shape, "transformed") else transformed(shape, moved)
