"""Usual metrics of harvests: fruit per hour, success, losses and damage, with intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greenhouse_gym.envs.actions import INTERVAL
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation.records import Record

RESAMPLES = 2000
"""Number of bootstrap samples."""

METRICS = {
    "fruit_per_hour": ("crated", "hours", 1.0),
    "seconds_per_fruit": ("seconds", "crated", 1.0),
    "harvested": ("crated", "wanted", 1.0),
    "detached": ("detached", "wanted", 1.0),
    "dropped": ("dropped", "detached", 1.0),
    "missed": ("missed", "wanted", 1.0),
    "knocked_per_100": ("knocked", "wanted", 100.0),
    "damage_per_100": ("damaged", "wanted", 100.0),
}
"""Metrics as ratios of sums over episodes, by name: numerator, denominator and factor. Time is simulated time in which
the arm moves; fruit are those to be picked; "missed" fruit are neither in the crate nor dropped."""


def harvest_metrics(records: Sequence[Record], interval: float = INTERVAL) -> dict[str, tuple[float, float, float]]:
    """Return each of `METRICS` with its 95 % bootstrap interval over the episodes.

    Args:
        records: Episodes of the task "harvest".
        interval: Time between two actions, seconds.

    Raises:
        InvalidValueError: There is no record, or one of another task.
    """
    if not records or any("crated" not in record.measures for record in records):
        raise InvalidValueError("harvest metrics need records of the task 'harvest', at least one")
    names = ("wanted", "detached", "crated", "dropped", "knocked", "damaged", "worked")
    counts = {name: np.array([record.measures[name] for record in records]) for name in names}
    counts["seconds"] = counts["worked"] * interval
    counts["hours"] = counts["seconds"] / 3600
    counts["missed"] = counts["wanted"] - counts["crated"] - counts["dropped"]
    picks = np.random.default_rng(0).integers(len(records), size=(RESAMPLES, len(records)))
    result = {}
    for name, (above, below, factor) in METRICS.items():
        value = factor * _ratio(counts[above].sum(), counts[below].sum())
        samples = factor * _ratio(counts[above][picks].sum(axis=1), counts[below][picks].sum(axis=1))
        known = samples[np.isfinite(samples)]
        low, high = np.percentile(known, [2.5, 97.5]) if len(known) else (np.nan, np.nan)
        result[name] = (float(value), float(low), float(high))
    return result


def _ratio(above: np.ndarray, below: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.divide(above, below)
