"""Bodies filled with organs, remembered by scene so that a reset copies them instead of computing them again."""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import ShapeArrays
from greenhouse_gym.scene.plants.mechanics import PlantMechanics
from greenhouse_gym.scene.plants.topology import Leaf

_GEOMS = (
    "geom_type", "geom_pos", "geom_size", "geom_quat", "geom_aabb", "geom_rbound", "geom_sameframe", "geom_rgba",
    "geom_conaffinity",
)  # fmt: skip
_BODY = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_sameframe")
_TREE = ("bvh_depth", "bvh_child", "bvh_nodeid", "bvh_aabb")


@dataclass
class FilledBodies:
    """Shapes, mass properties and trees of the bodies of a scene that have been filled so far.

    Bodies are remembered for one kind of mechanics at a time, the last one.

    Attributes:
        plates: Merged plates of leaves, which do not depend on the mechanics.
    """

    plates: dict[Leaf, ShapeArrays] = field(default_factory=dict)
    _mechanics: PlantMechanics | None = None
    _bodies: dict[Hashable, list[npt.NDArray[np.generic]]] = field(default_factory=dict)

    def recall(self, model: mujoco.MjModel, body: int, organ: Hashable, mechanics: PlantMechanics) -> bool:
        """Fill an empty body with an organ as it was filled before; return False if it is the first time."""
        if mechanics != self._mechanics:
            self._mechanics, self._bodies = mechanics, {}
        known = self._bodies.get(organ)
        for (name, part), values in zip(_parts(model, body) if known else (), known or (), strict=True):
            getattr(model, name)[part] = values
        if known:
            _shift_nodes(model, body, int(model.body_geomadr[body]))
        return known is not None

    def remember(self, model: mujoco.MjModel, body: int, organ: Hashable) -> None:
        """Remember how a body is filled with an organ."""
        first = int(model.body_geomadr[body])
        _shift_nodes(model, body, -first)
        self._bodies[organ] = [getattr(model, name)[part].copy() for name, part in _parts(model, body)]
        _shift_nodes(model, body, first)


def _parts(model: mujoco.MjModel, body: int) -> Iterator[tuple[str, slice]]:
    """Yield the fields of a model that describe a filled body, and where its values are."""
    geoms, nodes = int(model.body_geomadr[body]), int(model.body_bvhadr[body])
    for names, first, count in (
        (_GEOMS, geoms, int(model.body_geomnum[body])),
        (_BODY, body, 1),
        (_TREE, nodes, int(model.body_bvhnum[body])),
    ):
        for name in names:
            yield name, slice(first, first + count)


def _shift_nodes(model: mujoco.MjModel, body: int, by: int) -> None:
    """Shift the geoms that the tree of a body refers to."""
    first = int(model.body_bvhadr[body])
    ids = model.bvh_nodeid[first : first + int(model.body_bvhnum[body])]
    ids[ids >= 0] += by
