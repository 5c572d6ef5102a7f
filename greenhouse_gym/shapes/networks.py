"""Small classifier networks, stored as JSON and evaluated with numpy alone."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from greenhouse_gym.geometry import Array

_MAX_DEVIATION = 8.0  # standardized features are clipped to this


@dataclass(frozen=True, eq=False)
class Network:
    """Binary classifier with one hidden layer.

    Attributes:
        center: (m,) mean of each feature.
        scale: (m,) standard deviation of each feature.
        hidden: (m, h) weights of the hidden layer.
        hidden_offset: (h,) offsets of the hidden layer.
        out: (h,) weights of the output.
        out_offset: (1,) offset of the output.
    """

    center: Array
    scale: Array
    hidden: Array
    hidden_offset: Array
    out: Array
    out_offset: Array

    def __call__(self, features: Array) -> Array:
        """Return probabilities (k,) for features (k, m)."""
        inputs = np.clip((features - self.center) / self.scale, -_MAX_DEVIATION, _MAX_DEVIATION)
        hidden = np.tanh(inputs @ self.hidden + self.hidden_offset)
        return np.asarray(1 / (1 + np.exp(-(hidden @ self.out + self.out_offset))))


def network_file(name: str) -> Path:
    """Return the file of a shipped network such as "fruit/small_fruit"."""
    return Path(__file__).parent / f"{name}.json"


@cache
def network(name: str) -> Network:
    """Load a shipped network by the name that `network_file` takes."""
    stored = json.loads(network_file(name).read_text())
    return Network(**{name: np.array(values) for name, values in stored.items()})
