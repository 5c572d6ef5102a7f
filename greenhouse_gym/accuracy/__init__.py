"""Accuracy of reconstructions and shapes where the truth is known.

Clouds: drift, distance to the truth, completeness. Shapes: tomatoes and trusses, stems by length, coverage and excess.
"""

from greenhouse_gym.accuracy.clouds import (
    Drift,
    ReconstructedRow,
    align,
    completeness,
    distance_to_surface,
    distance_to_truth,
    drift,
    place,
    place_by_windows,
    visible_surface,
)
from greenhouse_gym.accuracy.cover import coverage, excess, skin_points
from greenhouse_gym.accuracy.stems import StemComparison, compare_stems, pool_stems
from greenhouse_gym.accuracy.tomatoes import (
    OCCLUSION_BANDS,
    RIPENESS_BANDS,
    Matches,
    TomatoComparison,
    compare_tomatoes,
    match_tomatoes,
    pool_tomatoes,
)
from greenhouse_gym.accuracy.visibility import (
    Pieces,
    Visibility,
    VisibleRow,
    cut,
    visibility,
    visible_row,
    visible_tomatoes,
)

__all__ = [
    "OCCLUSION_BANDS",
    "RIPENESS_BANDS",
    "Drift",
    "Matches",
    "Pieces",
    "ReconstructedRow",
    "StemComparison",
    "TomatoComparison",
    "Visibility",
    "VisibleRow",
    "align",
    "compare_stems",
    "compare_tomatoes",
    "completeness",
    "coverage",
    "cut",
    "distance_to_surface",
    "distance_to_truth",
    "drift",
    "excess",
    "match_tomatoes",
    "place",
    "place_by_windows",
    "pool_stems",
    "pool_tomatoes",
    "skin_points",
    "visibility",
    "visible_row",
    "visible_surface",
    "visible_tomatoes",
]
