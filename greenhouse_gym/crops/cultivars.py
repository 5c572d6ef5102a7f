"""Fruit styles of analytic plants and cultivars of mesh plants, by name."""

from __future__ import annotations

from dataclasses import dataclass, replace

from greenhouse_gym.crops.crop import Color

RED: tuple[Color, ...] = ((0.50, 0.56, 0.30), (0.74, 0.64, 0.24), (0.86, 0.44, 0.14), (0.76, 0.11, 0.08))
"""Skin at ripeness 0, 1/3, 2/3 and 1: from green with redness -0.06, close to photographs (-0.03), to red."""


@dataclass(frozen=True)
class Cultivar:
    """Growth of a cultivar; ranges are (minimum, maximum) and sampled uniformly.

    Sizes of fruit and numbers per truss are published values. A crop with a leaf area index of 3 and 1.6 m between rows
    carries 4.8 m2 of leaf per metre of row, on two lines over two metres of height. The default leaf area is the part
    of one line between 1.15 m, above the ripe trusses, and 2.4 m, the top of the model.

    Attributes:
        model: Helios' plant model, ``"tomato"`` or ``"cherrytomato"``; determines the form of leaves and trusses.
        count: Fruits per truss.
        diameter: Width of a grown fruit, metres.
        aspect: Height of a fruit over its width: below 1 oblate, above 1.25 a plum; sampled per row.
        ribs: Depth of the ribs as a fraction of the radius; sampled per truss.
        skin: Color of the skin at ripeness 0, 1/3, 2/3 and 1.
        rachis: Length of peduncle and rachis together, metres.
        peduncle_radius: Radius of a peduncle, metres; sampled per truss.
        stem_radius: Radius of the main stem at the gutter, metres; sampled per plant.
        winding: Radius at which the stem winds around its string, metres.
        leaf_area: Area of all leaves, one side, square metres per metre of row.
        leaf_redness: Median of the leaves' (R - G) / (R + G) in white light; sampled per row.
        leaf_curl: Helios' longitudinal curvature of a leaflet, negative downwards; sampled per leaflet.
        leaf_width: Width of a leaflet over its length.
        bare_below: Height below which leaves are taken off, metres.
        flowering: Height at which the youngest truss opens, metres; sampled per plant. Lower than on real vines
            (prior), so that the cameras see fruit of every age.
        side_shoots: Probability of a side shoot in the axil of a leaf.
        shoot_length: Length of a side shoot, metres.
        lines: Lines of plants in a row, 0.35 m apart; a commercial row has two on one gutter.
    """

    model: str = "tomato"
    count: tuple[int, int] = (3, 5)
    diameter: tuple[float, float] = (0.045, 0.067)
    aspect: tuple[float, float] = (0.82, 0.95)
    ribs: tuple[float, float] = (0.0, 0.03)
    skin: tuple[Color, ...] = RED
    rachis: float = 0.13
    peduncle_radius: tuple[float, float] = (0.0015, 0.00225)
    stem_radius: tuple[float, float] = (0.004, 0.007)
    winding: float = 0.006
    leaf_area: float = 1.5
    leaf_redness: tuple[float, float] = (-0.30, -0.07)
    leaf_curl: tuple[float, float] = (-0.45, -0.20)
    leaf_width: float = 0.55
    bare_below: float = 1.15
    flowering: tuple[float, float] = (1.6, 1.9)
    side_shoots: float = 0.08
    shoot_length: tuple[float, float] = (0.04, 0.20)
    lines: int = 1


_CLUSTER = Cultivar()
_BEEFSTEAK = Cultivar(
    count=(3, 4), diameter=(0.067, 0.095), aspect=(0.70, 0.85), ribs=(0.03, 0.09), stem_radius=(0.005, 0.008)
)
_CHERRY = Cultivar(
    model="cherrytomato",
    count=(10, 20),
    diameter=(0.026, 0.034),
    aspect=(0.92, 1.02),
    ribs=(0.0, 0.01),
    rachis=0.17,
    peduncle_radius=(0.00125, 0.00165),
)
_PLUM = Cultivar(diameter=(0.038, 0.050), aspect=(1.3, 1.6), ribs=(0.0, 0.02))

DEVELOPMENT_CULTIVARS = {
    "cluster": _CLUSTER,
    "beefsteak": _BEEFSTEAK,
    "cherry": _CHERRY,
    "plum": _PLUM,
    "stout": replace(_CLUSTER, stem_radius=(0.011, 0.015), winding=0.003),
    "bushy": replace(
        _CLUSTER,
        leaf_area=2.5,
        bare_below=0.55,
        side_shoots=0.35,
        shoot_length=(0.15, 0.6),
        winding=0.02,
        stem_radius=(0.005, 0.012),
    ),
    "dense": replace(_CLUSTER, leaf_area=4.8, lines=2, bare_below=0.8),
}
"""For development: the fruit styles, and cluster tomatoes on thick stems, untrained, or with a leaf area index of 3."""

HELD_OUT_CULTIVARS = {
    "held-out-cluster": Cultivar(
        model="cherrytomato",
        count=(4, 6),
        diameter=(0.040, 0.058),
        aspect=(0.88, 1.0),
        skin=((0.44, 0.55, 0.28), (0.70, 0.62, 0.30), (0.84, 0.48, 0.28), (0.78, 0.20, 0.19)),
        leaf_area=1.9,
        leaf_redness=(-0.33, -0.05),
        leaf_curl=(-0.25, 0.05),
        leaf_width=0.45,
        bare_below=1.05,
        side_shoots=0.12,
    ),
    "held-out-beefsteak": Cultivar(
        count=(2, 4),
        diameter=(0.072, 0.100),
        aspect=(0.62, 0.78),
        ribs=(0.06, 0.14),
        skin=((0.53, 0.58, 0.36), (0.72, 0.60, 0.28), (0.85, 0.45, 0.25), (0.70, 0.16, 0.14)),
        stem_radius=(0.006, 0.010),
        leaf_area=1.3,
        leaf_redness=(-0.33, -0.05),
        leaf_curl=(-0.60, -0.35),
        leaf_width=0.65,
        bare_below=1.25,
    ),
    "held-out-cherry": Cultivar(
        count=(8, 16),
        diameter=(0.022, 0.030),
        aspect=(0.95, 1.15),
        ribs=(0.0, 0.01),
        skin=((0.47, 0.57, 0.25), (0.76, 0.68, 0.22), (0.88, 0.60, 0.12), (0.87, 0.42, 0.08)),
        rachis=0.19,
        peduncle_radius=(0.00115, 0.00165),
        leaf_area=1.7,
        leaf_redness=(-0.33, -0.05),
        leaf_width=0.48,
        side_shoots=0.12,
    ),
    "held-out-plum": Cultivar(
        model="cherrytomato",
        count=(4, 7),
        diameter=(0.032, 0.044),
        aspect=(1.25, 1.7),
        ribs=(0.0, 0.03),
        leaf_area=1.6,
        leaf_redness=(-0.33, -0.05),
        leaf_curl=(-0.35, -0.10),
    ),
}
"""For measurements only: other sizes, colors, leaves and densities. Nothing is tuned on them."""

CULTIVARS = DEVELOPMENT_CULTIVARS | HELD_OUT_CULTIVARS
"""All cultivars of mesh plants by name."""


@dataclass(frozen=True)
class FruitStyle:
    """Fruit of an analytic plant.

    Attributes:
        count: Minimum and maximum number of fruits per truss.
        diameter: Minimum and maximum diameter of a fruit, metres.
        rachis: Length of peduncle and rachis together, metres.
    """

    count: tuple[int, int]
    diameter: tuple[float, float]
    rachis: float


STYLES = {
    "cluster": FruitStyle(count=(3, 5), diameter=(0.045, 0.067), rachis=0.13),
    "beefsteak": FruitStyle(count=(3, 4), diameter=(0.067, 0.095), rachis=0.13),
    "cherry": FruitStyle(count=(10, 20), diameter=(0.026, 0.034), rachis=0.17),
}
"""Fruit styles by name, with numbers and sizes of grown fruit."""
