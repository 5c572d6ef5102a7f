"""Whether confidence means what it says, and how small fruit fares."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.accuracy import match_tomatoes
from greenhouse_gym.crops.parts import Tomato

SMALL = 0.012
"""Radius in metres below which fruit counts as small."""


def credited(true: Sequence[Tomato], found: Sequence[Tomato]) -> list[bool]:
    """Which of the tomatoes found are true ones, visible or hidden."""
    right = np.zeros(len(found), dtype=bool)
    right[match_tomatoes(true, found).found] = True
    return right.tolist()


def small_tomatoes(true: Sequence[Tomato], visible: npt.NDArray[np.bool_], found: Sequence[Tomato]) -> dict[str, int]:
    """Small visible fruit, those found of it, and false fruit as small."""
    matches = match_tomatoes(true, found)
    small = np.array([t.radius < SMALL for t in true], dtype=bool) & visible
    false = [t for t, right in zip(found, credited(true, found), strict=True) if not right and t.radius < SMALL]
    return {"visible": int(small.sum()), "found": int(small[matches.true].sum()), "false": len(false)}


def calibration(records: Sequence[Sequence[Sequence[Any]]], bins: int = 5) -> dict[str, Any]:
    """Of pairs (confidences, which are right): share that is right at 0.8 and above, and bin by bin."""
    confidence = np.array([c for said, _ in records for c in said], dtype=np.float64)
    right = np.array([r for _, true in records for r in true], dtype=bool)
    edges = np.linspace(0.0, 1.0, bins + 1)
    which = np.clip(np.digitize(confidence, edges) - 1, 0, bins - 1)
    counts = np.bincount(which, minlength=bins)
    return {
        "sure": int((confidence >= 0.8).sum()),
        "sure_and_true": float(right[confidence >= 0.8].mean()) if (confidence >= 0.8).any() else float("nan"),
        "edges": edges.tolist(),
        "counts": counts.tolist(),
        "true": [float(right[which == k].mean()) if counts[k] else float("nan") for k in range(bins)],
    }
