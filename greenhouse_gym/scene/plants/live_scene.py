"""Scene to plan in, made of the plants of a running simulation."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from greenhouse_gym.geometry import Array, Box, pose, transformed
from greenhouse_gym.scene import CompiledScene, Scene
from greenhouse_gym.scene.plants.live import HANGING, LivePlants

_AT_REST = 2e-4  # metres and radians by which an organ may have moved and still be where it was scanned


class LiveScene(NamedTuple):
    """Scene with its plants in their current poses.

    Attributes:
        scene: The scene, with the crate; fruit that came off are left out.
        tomatoes: Index in it of each fruit that hangs, by its index in the slots.
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
    gone: set[int] = set()
    slot_of = {int(row): k for k, row in enumerate(planted.fruit.ravel()) if row >= 0}

    def move(rows: Any, body: int, origin: Array) -> None:
        moved = pose(data.xmat[body].reshape(3, 3), data.xpos[body]) @ pose(np.eye(3), -origin)
        if np.abs(moved - np.eye(4)).max() < _AT_REST:
            return
        for row in rows:
            shapes[row] = _moved(shapes[row], moved)

    for i, truss in enumerate(planted.trusses):
        if plants.cut[i]:
            gone.update(truss.rows, *((fruit.row, *fruit.pedicel) for fruit in truss.fruit))
            continue
        body = int(planted.ids.truss[i])
        move(truss.rows, body, truss.root)
        for fruit in truss.fruit:
            slot = slot_of.get(fruit.row)
            if slot is None:
                move((fruit.row, *fruit.pedicel), body, truss.root)
            elif plants.state[slot] == HANGING:
                move((fruit.row, *fruit.pedicel), int(planted.ids.fruit.ravel()[slot]), fruit.joint)
            else:
                gone.update((fruit.row, *fruit.pedicel))
    kept = set(planted.topology.fixed)
    for i, leaf in enumerate(planted.leaves if leaves else ()):
        move((*leaf.rows, *leaf.plates), int(planted.ids.leaf[i]), leaf.root)
        kept.update((*leaf.rows, *leaf.plates))
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
    hanging = {slot: indices[row] for row, slot in slot_of.items() if row in indices}
    return LiveScene(scene.model_copy(update={**parts, "targets": (), "truth": None, "occupancy": None}), hanging)


def _moved(shape: Any, moved: Array) -> Any:
    return shape.transformed(moved) if hasattr(shape, "transformed") else transformed(shape, moved)
