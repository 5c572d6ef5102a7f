"""Grow a vine with PyHelios (extra ``plants``) and return its organs as meshes. No other module imports PyHelios.

The vine is trained as a grower does it: no side shoots, 36 nodes, a truss in about every third axil. The
result is a set of organs, each in the frame of the node it grew from, that `greenhouse_gym.crops.mesh_growth` hangs
along a string.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import metadata
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from greenhouse_gym.crops.helios_meshes import Mesh, Soup, cut_along_lobes, flower_of, fruit_of
from greenhouse_gym.crops.organs import areas
from greenhouse_gym.errors import GrowthError, MissingDependencyError
from greenhouse_gym.geometry import Array

TRIED_VERSION = "0.1.38"
NODES = 36
DAYS = 55
_FIRST_LEAF, _LAST_LEAF = 6, 28  # nodes with grown leaves: the first are small, the last not yet expanded


class Frond(NamedTuple):
    """A compound leaf: its node at the origin, z along the stem, its petiole's foot towards +x.

    Attributes:
        petiole: (k, 4) axis and radii, metres.
        blade: All leaflets, cut along their lobes.
        tone: (t, 2) per triangle of the blade: brightness of the texture relative to its median, and redness
            (R - G) / (R + G) above its median.
    """

    petiole: Array
    blade: Mesh
    tone: Array

    @property
    def area(self) -> float:
        """Area of one side of the blade, square metres."""
        return float(areas(self.blade.vertices, self.blade.triangles).sum())


@dataclass(frozen=True, eq=False)
class Vine:
    """The organs of one vine.

    Attributes:
        fronds: Grown compound leaves in the order of their nodes.
        peduncles: (k, 4) axes and radii, in the frame of a frond.
        fruit: Skin of a fruit one metre wide, centered at the origin, stem end up.
        calyx: Sepals on that fruit.
        flower: An open flower with its foot at the origin, opening upwards, metres.
        flower_colors: (t, 3) of its triangles.
    """

    fronds: tuple[Frond, ...]
    peduncles: tuple[Array, ...]
    fruit: Mesh
    calyx: Mesh
    flower: Mesh
    flower_colors: Array


@cache
def pyhelios() -> ModuleType:
    """Import PyHelios at first use.

    Raises:
        MissingDependencyError: The extra ``plants`` is not installed, or PyHelios has an untested version.
    """
    try:
        version = metadata.version("pyhelios3d")
        import pyhelios as module
    except (ImportError, metadata.PackageNotFoundError) as error:
        raise MissingDependencyError("pyhelios3d", "plants") from error
    if version != TRIED_VERSION:
        raise MissingDependencyError(f"pyhelios3d {TRIED_VERSION} (there is {version}, which was not tried)", "plants")
    return module


@lru_cache(maxsize=12)
def grow_vine(
    seed: int, model: str = "tomato", leaf_curl: tuple[float, float] = (-0.45, -0.2), leaf_width: float = 0.55
) -> Vine:
    """Grow a vine and take its organs apart; the same arguments give the same vine. Takes about 1.5 s.

    Args:
        seed: Seed of Helios' random numbers.
        model: ``"tomato"`` or ``"cherrytomato"`` of Helios' plant library.
        leaf_curl: Range of the leaflets' curvature along their length, negative downwards.
        leaf_width: Width of a leaflet over its length.

    Raises:
        MissingDependencyError: PyHelios is missing or of an untested version.
        GrowthError: The vine bears no fruit, or Helios fails.
        FileFormatError: The leaf's texture is missing.
    """
    helios = pyhelios()
    with helios.Context() as context, helios.PlantArchitecture(context) as plants:
        plants.disableMessages()
        context.seedRandomGenerator(seed)
        try:
            plants.loadPlantModelFromLibrary(model)
            plants.defineShootType(
                "mainstem", _trained(plants.getCurrentShootParameters("mainstem"), leaf_curl, leaf_width)
            )
            plant = plants.buildPlantInstanceFromLibrary(base_position=_vector(helios, 0.0, 0.0, 0.0), age=0.0)
            # days to dormancy's end, first flowers, their opening, fruit set and ripeness; dormancy and leaf fall never
            plants.setPlantPhenologicalThresholds(plant, 0.0, 3.0, 2.0, 2.0, 10.0, 1e5, 1e5, True)
            flower = None
            days = 0.0
            while flower is None and days < DAYS:  # a flower lasts two days; at the end all have set fruit
                step = 1.0 if days else 14.0
                plants.advanceTime(step, plant_id=plant)
                days += step
                flowers = plants.getPlantFlowerObjectIDs(plant)
                flower = _soup(context, flowers[:1]) if flowers else None
            plants.advanceTime(max(DAYS - days, 1.0), plant_id=plant)
        except (helios.PlantArchitectureError, RuntimeError) as error:
            raise GrowthError(f"Helios could not grow a {model!r} vine with seed {seed}: {error}") from error
        fruits = plants.getPlantFruitObjectIDs(plant)
        peduncles = plants.getPlantPeduncleObjectIDs(plant)
        if not fruits or flower is None:
            raise GrowthError(f"the {model!r} vine with seed {seed} bears no {'fruit' if flower else 'flowers'}")
        fronds = _fronds(context, plants, plant)
        skin, sepals = fruit_of(_soup(context, fruits[:1]))
        peduncle_axes = tuple(_upright(_axis(context, one))[0] for one in peduncles)
    return Vine(fronds, peduncle_axes, skin, sepals, *flower_of(flower))


def _trained(parameters: dict[str, Any], leaf_curl: tuple[float, float], leaf_width: float) -> dict[str, Any]:
    """Return shoot parameters of a high-wire vine: no side shoots, longer internodes, a truss per three axils."""

    def constant(value: float) -> dict[str, Any]:
        return {"distribution": "constant", "parameters": [value]}

    for name in parameters:
        if name.startswith("vegetative_bud_break_probability"):
            parameters[name] = constant(0.0)
    parameters |= {
        "internode_length_max": constant(0.075),
        "phyllochron_min": constant(1.0),
        "elongation_rate_max": constant(0.2),
        "max_nodes": constant(NODES),
        "girth_area_factor": constant(0.45),
        "flower_bud_break_probability": constant(1 / 3),
        "determinate_shoot_growth": False,
    }
    parameters["phytomer_parameters"]["leaf"]["prototype"] |= {
        "subdivisions": 5,
        "longitudinal_curvature": {"distribution": "uniform", "parameters": list(leaf_curl)},
        "leaf_aspect_ratio": constant(leaf_width),
    }
    return parameters


def _soup(context: Any, objects: Sequence[int]) -> Soup:
    primitives = context.getObjectPrimitiveUUIDs(list(objects))
    flat, offsets = context.getPrimitiveVertices(primitives)
    if not np.all(np.diff(offsets) == 9):
        raise GrowthError("Helios gave primitives that are no triangles")
    coordinates, starts = context.getPrimitiveTextureUV(primitives)
    textured = np.diff(starts) == 6
    uv = np.full((len(primitives), 3, 2), np.nan)
    if textured.any():
        uv[textured] = np.asarray(coordinates, dtype=np.float64).reshape(-1, 3, 2)
    textures = {file for file in context.getPrimitiveTextureFile(primitives) if file}
    return Soup(
        np.asarray(flat, dtype=np.float64).reshape(-1, 3, 3),
        np.asarray(context.getPrimitiveColor(primitives), dtype=np.float64).reshape(-1, 3),
        uv,
        next(iter(sorted(textures)), ""),
    )


def _axis(context: Any, tube: int) -> Array:
    nodes = [(node.x, node.y, node.z) for node in context.getTubeObjectNodes(tube)]
    return np.column_stack([np.array(nodes), context.getTubeObjectNodeRadii(tube)])


def _upright(axis: Array) -> tuple[Array, Array]:
    """Return a tube's axis (k, 4) from its foot, rotated about z towards +x, and the rotation (3, 3)."""
    outward = axis[min(2, len(axis) - 1), :2] - axis[0, :2]
    c, s = outward / max(float(np.linalg.norm(outward)), 1e-9)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.column_stack([(axis[:, :3] - axis[0, :3]) @ turn.T, axis[:, 3]]), turn


def _fronds(context: Any, plants: Any, plant: int) -> tuple[Frond, ...]:
    petioles, leaflets = plants.getPlantPetioleObjectIDs(plant), plants.getPlantLeafObjectIDs(plant)
    each = len(leaflets) // len(petioles)  # both lists run from node to node
    fronds = []
    for node in range(_FIRST_LEAF, min(_LAST_LEAF, len(petioles))):
        axis = _axis(context, petioles[node])
        petiole, turn = _upright(axis)
        soup = _soup(context, leaflets[node * each : (node + 1) * each])
        blade, tone = cut_along_lobes(soup._replace(corners=(soup.corners - axis[0, :3]) @ turn.T))
        fronds.append(Frond(petiole, blade, tone))
    return tuple(fronds)


def _vector(helios: ModuleType, x: float, y: float, z: float) -> Any:
    return helios.types.vec3(x, y, z)
