"""Infos of environments, by key: masks in vector environments, and selection of numeric infos."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.simulation import STEP_INFOS
from greenhouse_gym.envs.state import Bools

Infos = dict[str, Any]
"""Arrays (n,) by key, or dicts of such arrays, each with a mask."""


def numbers_only(infos: Infos) -> Infos:
    """Return the numeric infos under one level of keys, nested ones as "contacts.leaf"."""
    result: Infos = {}
    for key, value in infos.items():
        if isinstance(value, dict):
            result |= {f"{key}.{inner}": number for inner, number in numbers_only(value).items()}
        elif np.asarray(value).dtype.kind not in "OU":
            result[key] = value
    return result


def masked(values: Infos, mask: Bools, stepped: Bools) -> Infos:
    """Return infos with a mask per key: ``stepped`` for keys that only steps have, else ``mask``.

    As in Gymnasium's vector environments, entries of other simulations are 0 or None, and keys that no simulation has
    are missing.
    """
    result: Infos = {}
    for key, part in values.items():
        own = stepped if key in STEP_INFOS else mask
        if own.any():
            result[key] = masked(part, own, own) if isinstance(part, dict) else _blanked(part, own)
            result[f"_{key}"] = own
    return result


def _blanked(values: npt.NDArray[Any], mask: Bools) -> npt.NDArray[Any]:
    if mask.all():
        return values
    blank = np.full_like(values, None if values.dtype == object else 0)
    blank[mask] = values[mask]
    return blank
