"""Cultivars of mesh plants: how they fruit, leaf and look."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Cultivar:
    """How a cultivar grows; ranges are (smallest, largest) and drawn evenly, per row, plant, truss or fruit.

    Attributes:
        model: Helios' plant model, ``"tomato"`` or ``"cherrytomato"``.
        count: Fruits per truss.
        diameter: Width of a grown fruit, metres.
        aspect: Height of a fruit over its width: below 1 oblate, above 1.25 a plum; drawn per row.
        ribs: Depth of the ribs as a share of the radius.
        rachis: Length of peduncle and rachis together, metres.
        peduncle_radius: Metres.
        stem_radius: Of the main stem at the gutter, metres.
        leaf_redness: Median of a leaf's (R - G) / (R + G) in white light; drawn per row.
        leaf_scale: Size of a leaf against Helios' own.
        bare_below: Leaves below this height are taken off, metres.
        flowering: Height at which the youngest truss opens, metres; drawn per plant.
        side_shoots: Chance of a side shoot in the axil of a leaf.
        lines: Lines of plants in a row, 0.35 m apart: a commercial row has two on one gutter.
        winding: How far the stem winds around its string, metres.
    """

    model: str = "tomato"
    count: tuple[int, int] = (3, 5)
    diameter: tuple[float, float] = (0.045, 0.067)
    aspect: tuple[float, float] = (0.82, 0.95)
    ribs: tuple[float, float] = (0.0, 0.03)
    rachis: float = 0.13
    peduncle_radius: tuple[float, float] = (0.0015, 0.00225)
    stem_radius: tuple[float, float] = (0.004, 0.007)
    leaf_redness: tuple[float, float] = (-0.30, -0.07)
    leaf_scale: tuple[float, float] = (1.3, 1.6)
    bare_below: float = 1.15
    flowering: tuple[float, float] = (1.6, 1.9)
    side_shoots: float = 0.08
    lines: int = 1
    winding: float = 0.006


CULTIVARS = {
    "cluster": Cultivar(),
    "beefsteak": Cultivar(
        count=(3, 4), diameter=(0.067, 0.095), aspect=(0.70, 0.85), ribs=(0.03, 0.09), stem_radius=(0.005, 0.008)
    ),
    "cherry": Cultivar(
        model="cherrytomato",
        count=(10, 20),
        diameter=(0.026, 0.034),
        aspect=(0.92, 1.02),
        ribs=(0.0, 0.01),
        rachis=0.17,
        peduncle_radius=(0.00125, 0.00165),
        leaf_scale=(0.75, 0.95),
    ),
    "plum": Cultivar(diameter=(0.038, 0.050), aspect=(1.3, 1.6), ribs=(0.0, 0.02)),
}
"""Cultivars by fruit style."""
