"""Contacts of the arm by group: fruit, stem, leaf, fixture and self."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.state import Bools
from greenhouse_gym.scene import CompiledScene
from greenhouse_gym.scene.geom_order import first_world_geom
from greenhouse_gym.scene.plants.layout import CRATE_BOXES, SlotIds

CONTACT_GROUPS = ("fruit", "stem", "leaf", "fixture", "self")
"""Groups of contacts by the arm's counterpart. Leaves are all clutter that gives way, see
`greenhouse_gym.crops.parts.is_leaf`; fixtures are floor, cart, pipes, strings and gutters; "self" is a contact between
two parts of the arm."""

_FIXTURES = ("pipe", "string")
LEAF = CONTACT_GROUPS.index("leaf")
"""Index of the group of leaves."""

_FIXTURE, _SELF = CONTACT_GROUPS.index("fixture"), CONTACT_GROUPS.index("self")

Groups = npt.NDArray[np.int8]


class Contact(NamedTuple):
    """A contact between two geoms.

    Attributes:
        names: Names of the geoms, the arm's first; empty without a contact.
        self_collision: Whether both belong to the arm.
    """

    names: tuple[str, ...] = ()
    self_collision: bool = False


NO_CONTACT = Contact()

NAME_SEPARATOR = ", "
"""Text between the names of the two geoms in ``info["contact"]``."""


class Contacts(NamedTuple):
    """Contacts of n simulations during an action.

    Attributes:
        counts: (n, groups) contacts summed over the physics steps, until one ends the episode.
        leaf_steps: (n,) physics steps with a contact of a leaf, likewise.
        collided: (n,) whether a contact ended the episode.
        first: First contact of each simulation that collided, by its index.
    """

    counts: npt.NDArray[np.int64]
    leaf_steps: npt.NDArray[np.int64]
    collided: Bools
    first: dict[int, Contact]


def geom_groups(compiled: CompiledScene, ids: SlotIds | None = None) -> Groups:
    """Return the index (geoms,) into `CONTACT_GROUPS` of each geom of a compiled scene; the arm's are in "self".

    Args:
        compiled: The scene.
        ids: Ids of its slots for organs that give way; None if there are none.
    """
    scene, slots, world = compiled.scene, compiled.obstacle_geoms, int(compiled.model.body_geomnum[0])
    groups = np.full(compiled.model.ngeom, _SELF, dtype=np.int8)
    groups[:world] = _FIXTURE
    kinds = ["fruit"] * scene.counts[0]
    kinds += ["fixture" if kind in _FIXTURES else "stem" for kind in scene.columns.stem_kinds]
    groups[slots.start : slots.start + len(kinds)] = [CONTACT_GROUPS.index(kind) for kind in kinds]
    groups[compiled.leaf_geoms] = LEAF
    if ids is not None:
        _mark(groups, compiled.model, [*ids.truss, *ids.cut], "stem")
        _mark(groups, compiled.model, [*ids.fruit.ravel(), *ids.cut_fruit.ravel(), *ids.loose, ids.crate], "fruit")
        _mark(groups, compiled.model, ids.leaf, "leaf")
        crate = int(compiled.model.body_geomadr[ids.crate])
        groups[crate : crate + CRATE_BOXES] = _FIXTURE
    return groups


def _mark(groups: Groups, model: mujoco.MjModel, bodies: Iterable[int], group: str) -> None:
    """Put the geoms of bodies into a group."""
    for body in bodies:
        first = int(model.body_geomadr[body])
        groups[first : first + int(model.body_geomnum[body])] = CONTACT_GROUPS.index(group)


def contact_groups(model: mujoco.MjModel, geoms: npt.NDArray[np.integer], groups: Groups) -> Groups:
    """Return the group of each contact.

    Args:
        model: A copy of the compiled model, its geoms in either order.
        geoms: (contacts, 2) ids of the geoms in contact.
        groups: `geom_groups` of the compiled scene.
    """
    compiled = (geoms - first_world_geom(model)) % model.ngeom
    return np.asarray(groups[compiled].min(axis=1))  # the arm's own group is the largest
