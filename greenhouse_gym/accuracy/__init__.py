"""How right a reconstruction is, where the truth is known: drift, cloud to truth, completeness, tomatoes found."""

from greenhouse_gym.accuracy.clouds import (
    Drift,
    ReconstructedRow,
    distance_to_surface,
    distance_to_truth,
    drift,
    place,
    place_by_windows,
)
from greenhouse_gym.accuracy.completeness import completeness, visible_surface
from greenhouse_gym.accuracy.tomatoes import Matches, match_tomatoes, visible_tomatoes

__all__ = [
    "Drift",
    "Matches",
    "ReconstructedRow",
    "completeness",
    "distance_to_surface",
    "distance_to_truth",
    "drift",
    "match_tomatoes",
    "place",
    "place_by_windows",
    "visible_surface",
    "visible_tomatoes",
]
