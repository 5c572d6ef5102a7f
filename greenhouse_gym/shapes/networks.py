"""Small networks that say how likely something is by its measures; read from JSON, and played without PyTorch.

training/shape_networks.py, training/shape_networks.py and training/shape_networks.py fit them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from greenhouse_gym.geometry import Array

_MOST = 8.0  # deviations from the mean beyond which a measure counts no more


@dataclass(frozen=True, eq=False)
class Network:
    """Says how likely things are what they are judged for, with one hidden layer.

    Attributes:
        center: (m,) of the measures.
        scale: (m,) of them.
        hidden: (m, h) weights of the hidden layer.
        hidden_offset: (h,) offsets of it.
        out: (h,) weights of what it says.
        out_offset: (1,) offset of that.
    """

    center: Array
    scale: Array
    hidden: Array
    hidden_offset: Array
    out: Array
    out_offset: Array

    def __call__(self, measures: Array) -> Array:
        """Probabilities (k,) by measures (k, m)."""
        inputs = np.clip((measures - self.center) / self.scale, -_MOST, _MOST)
        hidden = np.tanh(inputs @ self.hidden + self.hidden_offset)
        return np.asarray(1 / (1 + np.exp(-(hidden @ self.out + self.out_offset))))


def network_file(name: str) -> Path:
    """Where the network of a name is kept."""
    return Path(__file__).with_name(f"{name}.json")


@cache
def network(name: str) -> Network:
    """One of the networks that are shipped.

    Args:
        name: "large_fruit" and "large_fruit_beside", for spheres of the first look and of the second by
            `candidates.MEASURES`, `candidates.COMPANY` and `surroundings.SURROUNDINGS`, "small_fruit", for others by
            the same in another order, "peduncles", for places by `thin_stems.MEASURES`, or "peduncles_in_context", for
            them by these and `likely_places.CONTEXT`.
    """
    stored = json.loads(network_file(name).read_text())
    return Network(**{name: np.array(values) for name, values in stored.items()})
