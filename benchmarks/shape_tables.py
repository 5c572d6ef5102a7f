"""The measurements of shapes.py pooled over rows, and as Markdown tables beside their goals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from shape_confidence import calibration

from greenhouse_gym.accuracy import (
    OCCLUSION_BANDS,
    RIPENESS_BANDS,
    StemComparison,
    TomatoComparison,
    pool_stems,
    pool_tomatoes,
)
from greenhouse_gym.crops.parts import STEM_KINDS
from greenhouse_gym.geometry import Array

Record = Mapping[str, Any]
Figures = dict[str, Any]


def pooled(records: Sequence[Record]) -> Figures:
    """All figures of some rows taken together; lengths in metres."""
    tomatoes = pool_tomatoes([_tomatoes(record["tomatoes"]) for record in records])
    whole = pool_tomatoes([_tomatoes(record["whole_tomatoes"]) for record in records])
    measured = pool_tomatoes([_tomatoes(record["measured_tomatoes"]) for record in records])
    colored = pool_tomatoes([_tomatoes(record["colored_tomatoes"]) for record in records])
    kinds = {kind: pool_stems([_stems(record["stems"][kind]) for record in records]) for kind in STEM_KINDS}
    thin = pool_stems([kinds["peduncle"], kinds["pedicel"]])
    counts = [count for record in records for count in record["primitives"]]
    return {
        "tomatoes": {
            "all": _tomato_figures(tomatoes),
            "whole": _tomato_figures(whole),
            "whole green": _tomato_figures(whole.of_ripeness(*RIPENESS_BANDS["green"])),
            "measured": _tomato_figures(measured),
            "colored": _tomato_figures(colored),
            "ripeness": {name: _tomato_figures(tomatoes.of_ripeness(*band)) for name, band in RIPENESS_BANDS.items()},
            "occlusion": {
                name: _tomato_figures(tomatoes.of_visible_fraction(*band)) for name, band in OCCLUSION_BANDS.items()
            },
            "center_error_median_unaligned": _quantile([e for r in records for e in r["unaligned_center_error"]], 0.5),
        },
        "trusses": {
            "visible": len(tomatoes.truss_right),
            "right": _mean(tomatoes.truss_right),
            "right_whole": _mean(whole.truss_right),
            "right_measured": _mean(measured.truss_right),
        },
        "stems": {
            "all": _stem_figures(pool_stems(list(kinds.values()))),
            **{kind: _stem_figures(comparison) for kind, comparison in kinds.items()},
            "peduncle and pedicel": _stem_figures(thin),
        },
        "coverage": _mean([record["coverage"] for record in records]),
        "excess": _mean([record["excess"] for record in records if "excess" in record]),
        "collisions": _collision_figures([record["collisions"] for record in records if "collisions" in record]),
        "small_tomatoes": _small([record["small_tomatoes"] for record in records]),
        "calibration": calibration([record["confidence"] for record in records]),
        "boxes": {name: _mean([r["boxes"][name] for r in records]) for name in records[0]["boxes"]},
        "primitives": {"mean": _mean(counts), "most": max(counts, default=0)},
        "seconds_per_metre": _mean([record["seconds_per_metre"] for record in records]),
        "processor_seconds_per_metre": _mean([record["processor_seconds_per_metre"] for record in records]),
    }


def _tomato_figures(tomatoes: TomatoComparison) -> Figures:
    found = tomatoes.found
    return {
        "visible": len(found),
        "found": int(np.count_nonzero(found)),
        "false": len(tomatoes.false),
        "precision": tomatoes.precision,
        "recall": tomatoes.recall,
        "f1": tomatoes.f1,
        "center_error_median": _quantile(tomatoes.center_error[found], 0.5),
        "center_error_95": _quantile(tomatoes.center_error[found], 0.95),
        "diameter_error_median": _quantile(tomatoes.diameter_error[found], 0.5),
    }


def _stem_figures(stems: StemComparison) -> Figures:
    return {
        "visible": stems.visible,
        "extracted": stems.extracted,
        "recall": stems.recall,
        "recall_as_such": stems.recall_as_such,
        "false": stems.false_fraction,
        "false_on_petioles": stems.on_petioles / stems.extracted if stems.extracted else float("nan"),
        "axis_error_median": _quantile(stems.axis_error, 0.5),
        "radius_error_median": _quantile(stems.radius_error, 0.5),
    }


def _collision_figures(counts: Sequence[Mapping[str, int]]) -> Figures:
    names = counts[0] if counts else ("missed", "free_in_shapes", "invented", "free_in_truth")
    total = {name: sum(count[name] for count in counts) for name in names}
    return total | {
        "missed_share": total["missed"] / max(total["free_in_shapes"], 1),
        "invented_share": total["invented"] / max(total["free_in_truth"], 1),
    }


def _small(records: Sequence[Mapping[str, int]]) -> Figures:
    visible, found, false = (sum(record[name] for record in records) for name in ("visible", "found", "false"))
    f1 = 2 * found / (visible + found + false) if visible else float("nan")
    return {"visible": visible, "found": found, "false": false, "f1": f1}


def tables(figures: Mapping[str, Figures]) -> str:
    """The main table with its goals, and the tomatoes and stems in detail."""
    return "\n\n".join([_goals(figures), _tomato_table(figures), _stem_table(figures)])


def _goals(figures: Mapping[str, Figures]) -> str:
    lines = []
    for name, goal, read in _GOALS:
        lines.append((name, goal, *(read(own) for own in figures.values())))
    return _table(("figure", "goal", *figures), lines)


def _percent(value: float) -> str:
    return f"{value:.1%}"


def _mm(value: float) -> str:
    return f"{1e3 * value:.2f} mm"


_GOALS = (
    ("tomatoes: F1", ">= 0.96", lambda f: f"{f['tomatoes']['all']['f1']:.3f}"),
    ("green tomatoes: F1", ">= 0.92", lambda f: f"{f['tomatoes']['ripeness']['green']['f1']:.3f}"),
    ("tomatoes seen at 30 % of their silhouette: F1", "", lambda f: f"{f['tomatoes']['whole']['f1']:.3f}"),
    ("green ones of these: F1", "", lambda f: f"{f['tomatoes']['whole green']['f1']:.3f}"),
    ("tomatoes of which the cloud holds skin: F1", "", lambda f: f"{f['tomatoes']['measured']['f1']:.3f}"),
    ("tomatoes that color shows, with depth or without: F1", "", lambda f: f"{f['tomatoes']['colored']['f1']:.3f}"),
    ("tomato center, median", "<= 2.5 mm", lambda f: _mm(f["tomatoes"]["all"]["center_error_median"])),
    ("tomato center, median, unaligned", "", lambda f: _mm(f["tomatoes"]["center_error_median_unaligned"])),
    ("tomato center, 95 %", "<= 10 mm", lambda f: _mm(f["tomatoes"]["all"]["center_error_95"])),
    ("tomato diameter, median", "<= 2 %", lambda f: _percent(f["tomatoes"]["all"]["diameter_error_median"])),
    ("trusses exactly right", ">= 85 %", lambda f: _percent(f["trusses"]["right"])),
    ("trusses right, counting these", "", lambda f: _percent(f["trusses"]["right_whole"])),
    ("trusses right, counting tomatoes in the cloud", "", lambda f: _percent(f["trusses"]["right_measured"])),
    ("main stems: recall", ">= 0.95", lambda f: f"{f['stems']['main']['recall']:.3f}"),
    ("main stems: recall as main stems", "", lambda f: f"{f['stems']['main']['recall_as_such']:.3f}"),
    ("main stems: false", "<= 0.05", lambda f: f"{f['stems']['main']['false']:.3f}"),
    ("main stem axis, median", "<= 4 mm", lambda f: _mm(f["stems"]["main"]["axis_error_median"])),
    ("main stem radius, median", "<= 10 %", lambda f: _percent(f["stems"]["main"]["radius_error_median"])),
    ("stem axis of any kind, median", "<= 4 mm", lambda f: _mm(f["stems"]["all"]["axis_error_median"])),
    ("stem radius of any kind, median", "<= 10 %", lambda f: _percent(f["stems"]["all"]["radius_error_median"])),
    ("peduncles and pedicels: recall", ">= 0.80", lambda f: f"{f['stems']['peduncle and pedicel']['recall']:.3f}"),
    ("points within 8 mm of a shape", ">= 99 %", lambda f: _percent(f["coverage"])),
    ("surface beyond 15 mm of the truth", "<= 5 %", lambda f: _percent(f["excess"])),
    ("collides in the visible truth if free in shapes", "<= 2 %", lambda f: _percent(f["collisions"]["missed_share"])),
    ("collides in the shapes if free in the truth", "<= 5 %", lambda f: _percent(f["collisions"]["invented_share"])),
    ("primitives per scene, mean", "<= 300", lambda f: f"{f['primitives']['mean']:.0f}"),
    ("primitives per scene, most", "", lambda f: f"{f['primitives']['most']}"),
    ("fruit below 24 mm: F1", ">= 0.80", lambda f: f"{f['small_tomatoes']['f1']:.3f}"),
    ("true ones among confidence >= 0.8", ">= 90 %", lambda f: _percent(f["calibration"]["sure_and_true"])),
    ("found fruit with its front in a box", "<= 1 %", lambda f: _percent(f["boxes"]["fronts_inside"])),
    ("surface of boxes beyond 15 mm of all points", "<= 15 %", lambda f: _percent(f["boxes"]["empty_surface"])),
    ("points beyond 15 mm of all shapes", "<= 3 %", lambda f: _percent(f["boxes"]["points_left_out"])),
    ("time per metre", "<= 6 s", lambda f: f"{f['seconds_per_metre']:.2f} s"),
    ("processor time per metre", "", lambda f: f"{f['processor_seconds_per_metre']:.2f} s"),
)  # fmt: skip


def _tomato_table(figures: Mapping[str, Figures]) -> str:
    head = (
        "tomatoes",
        "",
        "visible",
        "found",
        "false",
        "precision",
        "recall",
        "F1",
        "center, median / 95 %",
        "diameter",
    )
    lines = []
    for cause, own in figures.items():
        groups = {"all": own["tomatoes"]["all"]} | own["tomatoes"]["ripeness"] | own["tomatoes"]["occlusion"]
        for name, f in groups.items():
            bare = name in OCCLUSION_BANDS  # a false tomato was not occluded by any share
            lines.append((
                cause, name, str(f["visible"]), str(f["found"]), "" if bare else str(f["false"]),
                "" if bare else f"{f['precision']:.3f}", f"{f['recall']:.3f}", "" if bare else f"{f['f1']:.3f}",
                f"{_mm(f['center_error_median'])} / {_mm(f['center_error_95'])}", _percent(f["diameter_error_median"]),
            ))  # fmt: skip
    return _table(head, lines)


def _stem_table(figures: Mapping[str, Figures]) -> str:
    head = ("stems", "", "visible", "extracted", "recall", "as such", "false", "on petioles", "axis", "radius")
    return _table(
        head,
        [
            (
                cause, kind, f"{f['visible']:.1f} m", f"{f['extracted']:.1f} m", f"{f['recall']:.3f}",
                f"{f['recall_as_such']:.3f}", f"{f['false']:.3f}", f"{f['false_on_petioles']:.3f}",
                _mm(f["axis_error_median"]), _percent(f["radius_error_median"]),
            )
            for cause, own in figures.items()
            for kind, f in own["stems"].items()
        ],
    )  # fmt: skip


def _tomatoes(record: Mapping[str, Any]) -> TomatoComparison:
    arrays = {name: np.array(value, dtype=np.float64) for name, value in record.items()}
    return TomatoComparison(**{**arrays, "truss_right": arrays["truss_right"].astype(bool)})


def _stems(record: Mapping[str, Any]) -> StemComparison:
    return StemComparison(**{name: np.array(v) if isinstance(v, list) else v for name, v in record.items()})


def _quantile(values: Sequence[float] | Array, share: float) -> float:
    return float(np.quantile(values, share)) if len(values) else float("nan")


def _mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in [head, ["---"] * len(head), *lines])
