"""Whether photographs were exposed so badly that their colors say nothing."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_BLACK, _BURNT = 0.03, 0.97  # all channels below, or above: nothing is left of a color
_MOST = 0.9  # share of the points that may be so


def exposure_failure(colors: npt.NDArray[np.floating]) -> str:
    """What is wrong with colors (n, 3) from 0 to 1 of nearly all points: a phrase for a message, or ""."""
    if not len(colors):
        return ""
    black, burnt = (colors < _BLACK).all(axis=1).mean(), (colors > _BURNT).all(axis=1).mean()
    if black > _MOST:
        return f"{black:.0%} of the points are black: the photographs are underexposed"
    if burnt > _MOST:
        return f"{burnt:.0%} of the points are burnt out to white: the photographs are overexposed"
    return ""
