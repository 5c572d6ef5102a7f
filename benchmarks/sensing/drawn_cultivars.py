"""Random cultivars over wide ranges, so that networks fitted to their rows do not depend on one appearance."""

from __future__ import annotations

from typing import Any

import numpy as np

from greenhouse_gym.crops.cultivars import RED, Cultivar

_SMALL = 0.35
"""Fraction of cultivars with cherry tomatoes."""


def drawn_cultivar(seed: int) -> Cultivar:
    """Sample a cultivar: fruit from cherry to beefsteak, flat to long, with more or less foliage.

    Sizes, counts and colors lie within published ranges; the deviation of colors from `RED` is a guess.
    """
    rng = np.random.default_rng([seed, 77])
    fruit = _fruit(rng)
    form = str(rng.choice(["oblate", "round", "long"], p=[0.35, 0.4, 0.25]))
    aspect = {"oblate": rng.uniform(0.65, 0.85), "round": rng.uniform(0.86, 1.0), "long": rng.uniform(1.15, 1.5)}[form]
    skin = tuple(_shade(color, rng) for color in RED)
    leaf_area, curl, stem = (float(rng.uniform(*ends)) for ends in ((1.0, 2.3), (-0.6, -0.15), (0.0038, 0.0065)))
    peduncle = float(rng.uniform(0.0011, 0.0016))
    side_shoots, ribs = float(rng.uniform(0.0, 0.15)), float(rng.uniform(0.0, 0.12 if form == "oblate" else 0.03))
    return Cultivar(
        model=str(rng.choice(["tomato", "cherrytomato"])),
        **fruit,
        aspect=(float(aspect), float(aspect) + 0.13),
        ribs=(0.4 * ribs, ribs),
        skin=skin,
        rachis=float(rng.uniform(0.11, 0.20)),
        peduncle_radius=(peduncle, 1.45 * peduncle),
        stem_radius=(stem, stem + 0.003),
        leaf_area=leaf_area,
        leaf_redness=(-0.33, -0.05),
        leaf_curl=(curl, curl + 0.27),
        leaf_width=float(rng.uniform(0.42, 0.68)),
        bare_below=float(rng.uniform(1.0, 1.25)),
        side_shoots=side_shoots,
    )


def _fruit(rng: np.random.Generator) -> dict[str, Any]:
    """Sample the number of fruits on a truss and their diameter."""
    small = rng.random() < _SMALL
    middle = float(np.exp(rng.uniform(*np.log((0.022, 0.034) if small else (0.034, 0.088)))))
    spread = rng.uniform(0.10, 0.20)
    low = int(rng.integers(7, 11) if small else rng.integers(2, 5))
    count = (low, low + int(rng.integers(4, 10) if small else rng.integers(1, 4)))
    return {"diameter": (middle * (1 - spread), middle * (1 + spread)), "count": count}


def _shade(color: tuple[float, float, float], rng: np.random.Generator) -> tuple[float, float, float]:
    red, green, blue = np.clip(np.array(color) * (1 + rng.normal(0, 0.06, 3)), 0.03, 0.95).tolist()
    return red, green, blue
