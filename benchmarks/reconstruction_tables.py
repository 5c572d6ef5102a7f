"""The measurements of reconstruction.py as Markdown tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from greenhouse_gym.capture import StereoNoise

Record = dict[str, Any]
USUAL_BIAS = StereoNoise().bias


def tables(records: Sequence[Record]) -> str:
    """All tables for which there are measurements."""
    usual = [r for r in records if not r["broken"] and r["bias"] == USUAL_BIAS]
    parts = [_rows(usual), _ratios(usual), _broken([r for r in records if r["broken"]]), _bias(records)]
    return "\n\n".join(part for part in parts if part)


def _rows(records: Sequence[Record]) -> str:
    """Every row and method."""
    head = (
        "row", "method", "registered", "drift", "cloud to truth, mean / 95 % mm", "unaligned", "complete", "unaligned",
        "s per station", "peak MiB",
    )  # fmt: skip
    return _table(
        head,
        [
            (
                _name(r), r["method"], f"{r['registered']} of {r['stations']}", f"{r['drift']:.2%}",
                _millimetres(r["distance_mean"], r["distance_95"]),
                _millimetres(r["distance_mean_unaligned"], r["distance_95_unaligned"]),
                f"{r['completeness']:.1%}", f"{r['completeness_unaligned']:.1%}",
                f"{r['seconds_per_station']:.2f}", f"{r['peak_memory'] / 2**20:.0f}",
            )
            for r in sorted(records, key=lambda r: (r["length"], r["seed"]))
        ],
    )  # fmt: skip


def _ratios(records: Sequence[Record]) -> str:
    """Means over the rows of a length, and how many times more drift and time the others have than the package."""
    lines = []
    for length in sorted({r["length"] for r in records}):
        means = {
            method: {key: np.mean([r[key] for r in own]) for key in ("drift", "seconds_per_station", "completeness")}
            for method in sorted({r["method"] for r in records})
            if (own := [r for r in records if r["length"] == length and r["method"] == method])
        }
        package = means.get("package")
        for method, mean in means.items():
            compared = [
                "" if package is None else f"{mean[key] / package[key]:.1f}" for key in ("drift", "seconds_per_station")
            ]
            lines.append((f"{length:g} m", method, f"{mean['drift']:.2%}", f"{mean['completeness']:.1%}", *compared))
    return _table(("rows", "method", "mean drift", "complete", "times the drift", "times the time"), lines)


def _broken(records: Sequence[Record]) -> str:
    """Rows with broken stations."""
    head = ("row, broken", "method", "good registered", "broken accepted", "of these misplaced", "drift", "complete")
    return _table(
        head,
        [
            (
                _name(r), r["method"], f"{r['good_registered'] / r['good']:.1%}",
                f"{len(r['broken_accepted'])} of {len(r['broken_stations'])}", str(len(r["broken_misplaced"])),
                f"{r['drift']:.2%}", f"{r['completeness']:.1%}",
            )
            for r in sorted(records, key=lambda r: (r["length"], r["seed"]))
        ],
    )  # fmt: skip


def _bias(records: Sequence[Record]) -> str:
    """The package's means over rows, by camera bias, where more than one was measured."""
    own = [r for r in records if r["method"] == "package" and not r["broken"]]
    swept = {(r["length"], r["seed"]) for r in own if r["bias"] != USUAL_BIAS}
    own = [r for r in own if (r["length"], r["seed"]) in swept]
    lines = []
    for bias in sorted({r["bias"] for r in own}):
        rows = [r for r in own if r["bias"] == bias]
        drift, mean, tail, complete = (
            np.mean([r[key] for r in rows]) for key in ("drift", "distance_mean", "distance_95", "completeness")
        )
        lines.append((f"{bias:.1%}", str(len(rows)), f"{drift:.2%}", _millimetres(mean, tail), f"{complete:.1%}"))
    return _table(("camera bias", "rows", "mean drift", "cloud to truth, mean / 95 % mm", "complete"), lines)


def _name(record: Record) -> str:
    return f"{record['length']:g} m, {record['seed']}"


def _millimetres(mean: float, tail: float) -> str:
    return f"{1e3 * mean:.2f} / {1e3 * tail:.2f}"


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    if not lines:
        return ""
    return "\n".join(f"| {' | '.join(line)} |" for line in [head, ["---"] * len(head), *lines])
