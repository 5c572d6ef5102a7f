"""Usual metrics of harvests: fruit per hour, success, losses and damage, with intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greenhouse_gym.common.tables import Table
from greenhouse_gym.envs.actions import INTERVAL
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.evaluation.records import Evaluation, Record

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


COLUMNS = {
    "crated": ("harvested", "{:.1%}"),
    "s a fruit": ("seconds_per_fruit", "{:.1f}"),
    "dropped": ("dropped", "{:.1%}"),
    "missed": ("missed", "{:.1%}"),
    "knocked off / 100": ("knocked_per_100", "{:.1f}"),
    "damaged / 100": ("damage_per_100", "{:.1f}"),
}
"""Columns of the table of harvests: a metric and its format."""


def is_harvest(evaluations: Sequence[Evaluation]) -> bool:
    """Return whether agents harvested."""
    return any("crated" in record.measures for e in evaluations for record in e.records)


def harvest_rows(evaluations: Sequence[Evaluation]) -> Table:
    """Return a table of harvests with 95 % intervals, a row per agent with records, that with most fruit first."""
    found = [(e, harvest_metrics(e.records)) for e in evaluations if e.records]
    found.sort(key=lambda pair: -pair[1]["harvested"][0])
    rows = [
        [
            e.agent, str(len(e.records)), f"{sum(record.measures['wanted'] for record in e.records):.0f}",
            *(_shown(metrics[name], form) for name, form in COLUMNS.values()),
        ]
        for e, metrics in found
    ]  # fmt: skip
    return Table(["agent", "stands", "fruit", *COLUMNS], rows)


def _shown(values: tuple[float, float, float], form: str) -> str:
    """Return a value with its interval as text; empty where it is unknown."""
    if not np.isfinite(values).all():
        return ""
    value, low, high = (form.format(value) for value in values)
    return f"{value} [{low.removesuffix('%')}, {high.removesuffix('%')}]"


def _ratio(above: np.ndarray, below: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.divide(above, below)
