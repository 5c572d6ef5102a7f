"""Organs of mesh plants from Helios: compound leaves, and trusses with peduncles, fruit, calyx and flowers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from greenhouse_gym.crops.analytic_growth import push_apart
from greenhouse_gym.crops.cultivars import Cultivar
from greenhouse_gym.crops.helios import Frond, Vine
from greenhouse_gym.crops.helios_meshes import Mesh
from greenhouse_gym.crops.organs import Organ, fruit_ellipsoid, tube_organ
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Array, frame_along, rotation_about

SHOOT_LEAVES_PER_METRE = 14.0
_PLAIN = np.array([[1.0, 0.0]])

_TRUSS_COLOR = (0.44, 0.56, 0.28)
_CALYX_COLOR = (0.36, 0.50, 0.22)
UP = np.array([0.0, 0.0, 1.0])


class LeafPalette(NamedTuple):
    """Leaf color of a plant: brightness R + G, redness (R - G) / (R + G), and blue as a fraction of R + G."""

    light: float
    redness: float
    blue: float

    def colors(self, tone: Array) -> Array:
        """Return colors (t, 3) of triangles with tones (t, 2) as in `Frond`."""
        light = self.light * tone[:, 0]
        redness = self.redness + 0.5 * tone[:, 1]
        rgb = np.column_stack([light * (1 + redness) / 2, light * (1 - redness) / 2, light * self.blue])
        return np.clip(rgb, 0.0, 1.0)


def leaf_palette(rng: np.random.Generator, redness: float) -> LeafPalette:
    """Sample the leaf color of a plant around its row's redness (prior: standard deviation 0.01 within a row)."""
    return LeafPalette(rng.uniform(0.58, 0.78), redness + rng.normal(0, 0.01), rng.uniform(0.15, 0.25))


def grow_frond(
    rng: np.random.Generator, frond: Frond, node: Array, azimuth: float, size: float, palette: LeafPalette
) -> list[Organ]:
    """Grow a compound leaf at a node.

    Args:
        rng: Source of all randomness.
        frond: Its shape.
        node: (4,) point on the main stem's axis and the stem's radius, metres.
        azimuth: Direction of growth about z, radians.
        size: Scale of Helios' leaf.
        palette: Its plant's color.

    Returns:
        The petiole and the blade.
    """
    droop = rotation_about(np.array([0.0, 1.0, 0.0]), rng.uniform(0.0, 0.6))
    turn = rotation_about(np.array([0.0, 0.0, 1.0]), azimuth) @ droop
    foot = node[:3] + node[3] * 0.5 * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    axis = np.column_stack([size * frond.petiole[:, :3] @ turn.T + foot, size * frond.petiole[:, 3]])
    aged = palette._replace(light=palette.light * rng.uniform(0.9, 1.1), redness=palette.redness + rng.normal(0, 0.012))
    stalk = aged._replace(light=1.15 * aged.light, redness=aged.redness + 0.05).colors(_PLAIN)[0]
    blade = size * frond.blade.vertices @ turn.T + foot
    return [
        tube_organ("petiole", axis, stalk, around=7),
        Organ("leaf", blade, frond.blade.triangles, aged.colors(frond.tone)),
    ]


def grow_shoot(
    rng: np.random.Generator,
    vine: Vine,
    node: Array,
    azimuth: float,
    length: float,
    leaf_size: float,
    palette: LeafPalette,
    color: Array,
) -> list[Organ]:
    """Grow a side shoot: a stem that leaves the axil steeply and bends up or sags, with leaves of its own.

    Args:
        rng: Source of all randomness.
        vine: Vine that provides the leaves.
        node: (4,) point on the main stem's axis and the stem's radius, metres.
        azimuth: Direction of growth about z, radians.
        length: Its length, metres.
        leaf_size: Scale of Helios' leaves.
        palette: Its plant's leaf color.
        color: (3,) color of its stem.
    """
    steps = max(3, int(length / 0.04))
    slopes = np.linspace(rng.uniform(0.5, 1.1), rng.uniform(-0.4, 1.2), steps)
    turns = azimuth + np.cumsum(rng.normal(0, 0.15, steps))
    along = np.column_stack([np.cos(slopes) * np.cos(turns), np.cos(slopes) * np.sin(turns), np.sin(slopes)])
    points = node[:3] + np.vstack([np.zeros(3), np.cumsum(along * length / steps, axis=0)])
    radii = min(0.6 * node[3], 0.0025 + 0.006 * length) * np.linspace(1.0, 0.6, steps + 1)
    axis = np.column_stack([points, radii])
    organs = [tube_organ("main", axis, color)]
    for leaf in range(1 + int(length * SHOOT_LEAVES_PER_METRE)):
        fraction = (leaf + 1) / (1 + int(length * SHOOT_LEAVES_PER_METRE))
        here = np.array([np.interp(fraction, np.linspace(0, 1, steps + 1), axis[:, k]) for k in range(4)])
        frond = vine.fronds[int(rng.integers(len(vine.fronds)))]
        size = leaf_size * float(rng.uniform(0.6, 1.1)) * (1.2 - 0.5 * fraction)
        organs += grow_frond(rng, frond, here, azimuth + 2.4 * (leaf + 1), size, palette)
    return organs


def fruit_size(age: float) -> float:
    """Return the relative width of a fruit at an age from 0 (flower) to 1 (red), a logistic curve.

    Tomatoes grow along a sigmoid that levels off before they turn red (prior: half the width at a quarter of the time).
    """
    return float(1 / (1 + np.exp(-9 * (age - 0.25))))


def ripeness_at(age: float) -> float:
    """Return the ripeness at an age: green until 0.55, red from 1 on."""
    return float(np.clip((age - 0.55) / 0.45, 0.0, 1.0))


class TrussNode(NamedTuple):
    """Position and numbers of a truss.

    Attributes:
        node: (4,) point on the main stem's axis and the stem's radius, metres.
        azimuth: Direction of growth about z, radians.
        truss: Its number.
        first_fruit: Index of its first tomato in the row.
    """

    node: Array
    azimuth: float
    truss: int
    first_fruit: int


def grow_mesh_truss(
    rng: np.random.Generator, vine: Vine, cultivar: Cultivar, aspect: float, place: TrussNode, age: float
) -> tuple[list[Organ], list[Tomato]]:
    """Grow one truss from a node of the main stem.

    Args:
        rng: Source of all randomness; the truss keeps its shape as it ages.
        vine: Vine that provides the organs.
        cultivar: Numbers and sizes.
        aspect: Height of a fruit over its width.
        place: Its position and numbers.
        age: 0 when its flowers open, 1 when its fruits are red; negative before.

    Returns:
        Its organs, and its tomatoes.
    """
    node, azimuth, truss, first_fruit = place
    number = int(rng.integers(cultivar.count[0], cultivar.count[1] + 1))
    peduncle = vine.peduncles[int(rng.integers(len(vine.peduncles)))]
    length = cultivar.rachis * rng.uniform(0.85, 1.15) * float(np.clip(0.4 + 2 * age, 0.3, 1.0))
    thickness = rng.uniform(*cultivar.peduncle_radius)
    full = rng.uniform(*cultivar.diameter) * rng.uniform(0.88, 1.0, number)
    stunted = rng.random(number) < 0.06
    full = np.where(stunted, full * rng.uniform(0.3, 0.6, number), np.clip(full, *cultivar.diameter))
    ages = age + np.linspace(0.05, -0.05, number) + rng.normal(0, 0.02, number)
    reach = rng.uniform(0.009, 0.022, number)
    noise = rng.normal(0, 0.15, (number, 3))
    spins = rng.uniform(0, 2 * np.pi, number)
    ribs, rib_count = rng.uniform(*cultivar.ribs), int(rng.integers(5, 9))
    if age < -0.1:
        return [], []

    turn = rotation_about(UP, azimuth)
    outward = turn[:, 0]
    own = peduncle[:, :3] * length / np.linalg.norm(np.diff(peduncle[:, :3], axis=0), axis=1).sum()
    points = own @ turn.T + node[:3]
    radii = thickness * np.interp(np.linspace(0, 1, len(points)), [0, 0.15, 1], [1.4, 1.0, 0.75])
    rachis = np.column_stack([points, radii])
    shade = np.array(_TRUSS_COLOR) * rng.uniform(0.9, 1.1)
    organs = [tube_organ("peduncle", rachis, shade, truss)]

    fractions = np.linspace(0.45, 1.0, number)
    joints = np.column_stack([np.interp(fractions, np.linspace(0, 1, len(points)), points[:, k]) for k in range(3)])
    sideways = np.cross(UP, outward)
    sides = np.where(np.arange(number) % 2 == 0, 1.0, -1.0) * (np.arange(number) < number - 1)
    directions = sides[:, None] * sideways + 0.4 * outward + [0.0, 0.0, -0.8] + noise
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    set_fruit = ages > 0.06
    widths = np.where(set_fruit, full * [fruit_size(a) for a in ages], 0.004)
    round_radii = widths / 2 * np.cbrt(aspect) * max(1.0, np.sqrt(aspect))
    centers = joints + (reach + round_radii)[:, None] * directions
    if number:
        centers = push_apart(centers, round_radii, joints, points, node[:3], float(node[3]))
    tomatoes: list[Tomato] = []
    for k in range(number):
        towards = (centers[k] - joints[k]) / np.linalg.norm(centers[k] - joints[k])
        if not set_fruit[k]:
            organs += _flower(vine, joints[k], directions[k], truss, shade)
            continue
        frame = frame_along(-towards) @ rotation_about(UP, spins[k])
        skin = _shaped(vine.fruit, widths[k], aspect, ribs, rib_count)
        ripe = ripeness_at(ages[k])
        vertices = skin.vertices @ frame.T + centers[k]
        organs.append(
            Organ(
                "fruit",
                vertices,
                skin.triangles,
                _skin_colors(skin, np.array(cultivar.skin), ripe, rng),
                truss,
                first_fruit + len(tomatoes),
            )
        )
        shape = fruit_ellipsoid(vertices, skin.triangles, frame)
        tomatoes.append(Tomato(shape, truss, ripe))
        top = widths[k] * aspect * vine.fruit.vertices[:, 2].max()
        organs += _calyx(vine, widths[k], full[k], top, frame, centers[k], truss, first_fruit + len(tomatoes) - 1)
        stem_end = centers[k] + frame[:, 2] * 0.85 * top
        organs.append(_pedicel(joints[k], stem_end, 0.7 * thickness, shade, truss))
    return organs, tomatoes


def _shaped(fruit: Mesh, width: float, aspect: float, ribs: float, rib_count: int) -> Mesh:
    """Scale Helios' fruit to a width and a height over width, with ribs that are deepest at the stem end."""
    x, y, z = fruit.vertices.T
    height = (z - z.min()) / (z.max() - z.min())
    fold = 1 - ribs * (0.35 + 0.65 * height) * (0.5 - 0.5 * np.cos(rib_count * np.arctan2(y, x)))
    tall = aspect / float(z.max() - z.min())
    return Mesh(width * np.column_stack([x * fold, y * fold, z * tall]), fruit.triangles)


def _skin_colors(skin: Mesh, stops: Array, ripeness: float, rng: np.random.Generator) -> Array:
    """Return the colors (t, 3) of a fruit, which reddens from its blossom end; its shoulders stay green longest."""
    height = skin.vertices[skin.triangles].mean(axis=1)[:, 2]
    height = (height - height.min()) / max(float(np.ptp(height)), 1e-9)
    lag = 0.35 * ripeness * (1 - ripeness) * 2
    local = np.clip(ripeness + lag * (0.5 - height), 0.0, 1.0)
    positions = np.linspace(0, 1, len(stops))
    colors = np.column_stack([np.interp(local, positions, stops[:, k]) for k in range(3)])
    return np.clip(colors * rng.normal(1.0, 0.05), 0.0, 1.0)


def _calyx(
    vine: Vine, width: float, full: float, top: float, frame: Array, center: Array, truss: int, fruit: int
) -> list[Organ]:
    """Return the sepals at the stem end, which grow earlier than the fruit."""
    size = 0.5 * width + 0.5 * min(full, 2.5 * width)
    local = vine.calyx.vertices * size
    local = local + [0.0, 0.0, top - size * vine.fruit.vertices[:, 2].max()]
    colors = np.tile(_CALYX_COLOR, (len(vine.calyx.triangles), 1))
    return [Organ("calyx", local @ frame.T + center, vine.calyx.triangles, colors, truss, fruit)]


def _flower(vine: Vine, joint: Array, direction: Array, truss: int, shade: Array) -> list[Organ]:
    """Return an open flower on its pedicel."""
    foot = joint + 0.012 * direction
    frame = frame_along(direction)
    vertices = vine.flower.vertices @ frame.T + foot
    return [
        Organ("flower", vertices, vine.flower.triangles, vine.flower_colors, truss),
        _pedicel(joint, foot, 0.0008, shade, truss),
    ]


def _pedicel(joint: Array, end: Array, radius: float, shade: Array, truss: int) -> Organ:
    """Return a pedicel, slightly bent upwards, with the knuckle at which it breaks."""
    fraction = np.array([0.0, 0.3, 0.5, 0.62, 0.74, 1.0])
    bow = 0.15 * np.linalg.norm(end - joint) * np.sin(np.pi * fraction)
    points = joint + fraction[:, None] * (end - joint) + bow[:, None] * UP
    radii = max(radius, 0.0008) * np.array([1.0, 0.95, 1.0, 1.35, 1.1, 1.25])
    return tube_organ("pedicel", np.column_stack([points, radii]), shade, truss)
