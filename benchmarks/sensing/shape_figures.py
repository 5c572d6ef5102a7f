"""Figures of `shapes.py`: measurements pooled over rows, calibration of the confidence, and tables with the goals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from benchmarks.common import table
from greenhouse_gym.accuracy import (
    OCCLUSION_BANDS,
    RIPENESS_BANDS,
    StemComparison,
    TomatoComparison,
    match_tomatoes,
    pool_stems,
    pool_tomatoes,
)
from greenhouse_gym.crops.parts import STEM_KINDS, Tomato
from greenhouse_gym.geometry import Array, Box, distance_to_shapes
from greenhouse_gym.shapes import RowShapes
from greenhouse_gym.shapes.evidence import nearest_shapes

SMALL = 0.012
"""Radius below which fruit counts as small, m."""
CONFIDENT = 0.8
"""Confidence from which a tomato counts as confident."""
VISIBILITIES = ("all", "whole", "measured", "colored")
"""Definitions of a visible tomato; `shapes.py` describes them."""

Record = Mapping[str, Any]
Figures = dict[str, Any]

_NUMBER, _PERCENT, _MM, _SECONDS = "{:.3f}", "{:.1%}", "{:.2f} mm", "{:.2f} s"
_GOALS = (
    ("tomatoes: F1", ">= 0.96", "tomatoes/all/f1", _NUMBER),
    ("green tomatoes: F1", ">= 0.92", "tomatoes/ripeness/green/f1", _NUMBER),
    ("tomatoes visible at 30 % of their silhouette: F1", "", "tomatoes/whole/f1", _NUMBER),
    ("green ones of these: F1", "", "tomatoes/whole green/f1", _NUMBER),
    ("tomatoes with skin in the cloud: F1", "", "tomatoes/measured/f1", _NUMBER),
    ("tomatoes that color shows, with depth or without: F1", "", "tomatoes/colored/f1", _NUMBER),
    ("tomato center, median", "<= 2.5 mm", "tomatoes/all/center_error_median", _MM),
    ("tomato center, median, unaligned", "", "tomatoes/center_error_median_unaligned", _MM),
    ("tomato center, 95 %", "<= 10 mm", "tomatoes/all/center_error_95", _MM),
    ("tomato diameter, median", "<= 2 %", "tomatoes/all/diameter_error_median", _PERCENT),
    ("trusses exactly right", ">= 85 %", "trusses/right", _PERCENT),
    ("trusses right, counting these", "", "trusses/right_whole", _PERCENT),
    ("trusses right, counting tomatoes in the cloud", "", "trusses/right_measured", _PERCENT),
    ("main stems: recall", ">= 0.95", "stems/main/recall", _NUMBER),
    ("main stems: recall as main stems", "", "stems/main/recall_as_such", _NUMBER),
    ("main stems: false", "<= 0.05", "stems/main/false", _NUMBER),
    ("main stem axis, median", "<= 4 mm", "stems/main/axis_error_median", _MM),
    ("main stem radius, median", "<= 10 %", "stems/main/radius_error_median", _PERCENT),
    ("stem axis of any kind, median", "<= 4 mm", "stems/all/axis_error_median", _MM),
    ("stem radius of any kind, median", "<= 10 %", "stems/all/radius_error_median", _PERCENT),
    ("peduncles and pedicels: recall", ">= 0.80", "stems/peduncle and pedicel/recall", _NUMBER),
    ("points within 8 mm of a shape", ">= 99 %", "coverage", _PERCENT),
    ("surface beyond 15 mm of the truth", "<= 5 %", "excess", _PERCENT),
    ("collides in the visible truth if free in shapes", "<= 2 %", "collisions/missed_fraction", _PERCENT),
    ("collides in the shapes if free in the truth", "<= 5 %", "collisions/invented_fraction", _PERCENT),
    ("primitives per scene, mean", "<= 300", "primitives/mean", "{:.0f}"),
    ("primitives per scene, maximum", "", "primitives/maximum", "{}"),
    ("fruit below 24 mm: F1", ">= 0.80", "small_tomatoes/f1", _NUMBER),
    ("true ones among confidence >= 0.8", ">= 90 %", "calibration/sure_and_true", _PERCENT),
    ("found fruit with its front in a box", "<= 1 %", "boxes/fronts_inside", _PERCENT),
    ("surface of boxes beyond 15 mm of all points", "<= 15 %", "boxes/empty_surface", _PERCENT),
    ("points beyond 15 mm of all shapes", "<= 3 %", "boxes/points_left_out", _PERCENT),
    ("time per metre", "<= 6 s", "seconds_per_metre", _SECONDS),
    ("processor time per metre", "", "processor_seconds_per_metre", _SECONDS),
)  # fmt: skip

FAR = 0.015
"""Distance from all points at which a box's surface is empty, and from all shapes at which a point is left out, m."""


def is_true(true: Sequence[Tomato], found: Sequence[Tomato]) -> npt.NDArray[np.bool_]:
    """Return which of the found tomatoes (n,) are true ones, visible or hidden."""
    right = np.zeros(len(found), dtype=bool)
    right[match_tomatoes(true, found).found] = True
    return right


def small_tomatoes(true: Sequence[Tomato], visible: npt.NDArray[np.bool_], found: Sequence[Tomato]) -> dict[str, int]:
    """Count small visible fruit, those of them that were found, and false small fruit."""
    small = np.array([t.radius < SMALL for t in true], dtype=bool) & visible
    false = [t for t, right in zip(found, is_true(true, found), strict=True) if not right and t.radius < SMALL]
    matched = match_tomatoes(true, found).true
    return {"visible": int(small.sum()), "found": int(small[matched].sum()), "false": len(false)}


def pooled(records: Sequence[Record]) -> Figures:
    """Return all figures of some rows taken together; lengths in m."""
    tomatoes = {
        name: pool_tomatoes([_tomatoes(record["tomatoes"][name]) for record in records]) for name in VISIBILITIES
    }
    usual = tomatoes["all"]
    kinds = {kind: pool_stems([_stems(record["stems"][kind]) for record in records]) for kind in STEM_KINDS}
    thin = pool_stems([kinds["peduncle"], kinds["pedicel"]])
    counts = [count for record in records for count in record["primitives"]]
    means = ("coverage", "excess", "seconds_per_metre", "processor_seconds_per_metre")
    return {
        "tomatoes": {
            **{name: _tomato_figures(comparison) for name, comparison in tomatoes.items()},
            "whole green": _tomato_figures(tomatoes["whole"].of_ripeness(*RIPENESS_BANDS["green"])),
            "ripeness": {name: _tomato_figures(usual.of_ripeness(*band)) for name, band in RIPENESS_BANDS.items()},
            "occlusion": {
                name: _tomato_figures(usual.of_visible_fraction(*band)) for name, band in OCCLUSION_BANDS.items()
            },
            "center_error_median_unaligned": _quantile([e for r in records for e in r["unaligned_center_error"]], 0.5),
        },
        "trusses": {
            "visible": len(usual.truss_right),
            "right": _mean(usual.truss_right),
            "right_whole": _mean(tomatoes["whole"].truss_right),
            "right_measured": _mean(tomatoes["measured"].truss_right),
        },
        "stems": {
            "all": _stem_figures(pool_stems(list(kinds.values()))),
            **{kind: _stem_figures(comparison) for kind, comparison in kinds.items()},
            "peduncle and pedicel": _stem_figures(thin),
        },
        **{name: _mean([record[name] for record in records if name in record]) for name in means},
        "collisions": _collision_figures([record["collisions"] for record in records if "collisions" in record]),
        "small_tomatoes": _small([record["small_tomatoes"] for record in records]),
        "calibration": calibration([record["confidence"] for record in records]),
        "boxes": {name: _mean([r["boxes"][name] for r in records]) for name in records[0]["boxes"]},
        "primitives": {"mean": _mean(counts), "maximum": max(counts, default=0)},
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
        "missed_fraction": total["missed"] / max(total["free_in_shapes"], 1),
        "invented_fraction": total["invented"] / max(total["free_in_truth"], 1),
    }


def _small(records: Sequence[Mapping[str, int]]) -> Figures:
    visible, found, false = (sum(record[name] for record in records) for name in ("visible", "found", "false"))
    f1 = 2 * found / (visible + found + false) if visible else float("nan")
    return {"visible": visible, "found": found, "false": false, "f1": f1}


def calibration(records: Sequence[Sequence[Sequence[Any]]], bins: int = 5) -> Figures:
    """Return the fraction of true tomatoes among the confident ones and by bins of confidence.

    Args:
        records: For every row the confidences, and which of the tomatoes are true.
        bins: Number of bins of equal width.
    """
    confidence = np.array([c for confidences, _ in records for c in confidences], dtype=np.float64)
    right = np.array([r for _, true in records for r in true], dtype=bool)
    edges = np.linspace(0.0, 1.0, bins + 1)
    which = np.clip(np.digitize(confidence, edges) - 1, 0, bins - 1)
    confident = confidence >= CONFIDENT
    return {
        "sure": int(confident.sum()),
        "sure_and_true": _mean(right[confident]),
        "edges": edges.tolist(),
        "counts": np.bincount(which, minlength=bins).tolist(),
        "true": [_mean(right[which == k]) for k in range(bins)],
    }


def tables(figures: Mapping[str, Figures]) -> str:
    """Return a table of all figures with their goals, one of tomatoes and one of stems, for every cause."""
    goals = [(name, goal, *(_text(own, path, form) for own in figures.values())) for name, goal, path, form in _GOALS]
    tomatoes, stems = [], []
    for cause, own in figures.items():
        groups = {"all": own["tomatoes"]["all"]} | own["tomatoes"]["ripeness"] | own["tomatoes"]["occlusion"]
        for name, f in groups.items():
            cells = [_text(f, key, _NUMBER) for key in ("precision", "recall", "f1")]
            if name in OCCLUSION_BANDS:  # a false tomato has no occlusion
                cells[0] = cells[2] = ""
            center = [_text(f, f"center_error_{key}", _MM) for key in ("median", "95")]
            false = "" if name in OCCLUSION_BANDS else f["false"]
            diameter = _text(f, "diameter_error_median", _PERCENT)
            tomatoes.append((cause, name, f["visible"], f["found"], false, *cells, " / ".join(center), diameter))
        for kind, f in own["stems"].items():
            lengths = [f"{f[key]:.1f} m" for key in ("visible", "extracted")]
            cells = [_text(f, key, _NUMBER) for key in ("recall", "recall_as_such", "false", "false_on_petioles")]
            errors = _text(f, "axis_error_median", _MM), _text(f, "radius_error_median", _PERCENT)
            stems.append((cause, kind, *lengths, *cells, *errors))
    tomato_heads = ("tomatoes", "", "visible", "found", "false", "precision", "recall", "F1", "center, median / 95 %")
    stem_heads = ("stems", "", "visible", "extracted", "recall", "as such", "false", "on petioles", "axis", "radius")
    return "\n\n".join(
        [
            table(("figure", "goal", *figures), goals),
            table((*tomato_heads, "diameter"), tomatoes),
            table(stem_heads, stems),
        ]
    )


def _text(figures: Mapping[str, Any], path: str, form: str) -> str:
    value: Any = reduce(lambda found, key: found[key], path.split("/"), figures)
    return form.format(1e3 * value if form == _MM else value)


def _tomatoes(record: Record) -> TomatoComparison:
    arrays = {name: np.array(value, dtype=np.float64) for name, value in record.items()}
    return TomatoComparison(**{**arrays, "truss_right": arrays["truss_right"].astype(bool)})


def _stems(record: Record) -> StemComparison:
    return StemComparison(**{name: np.array(v) if isinstance(v, list) else v for name, v in record.items()})


def _quantile(values: Sequence[float] | Array, at: float) -> float:
    return float(np.quantile(values, at)) if len(values) else float("nan")


def _mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def box_figures(shapes: RowShapes, points: Array) -> dict[str, float]:
    """Measure the boxes among a row's shapes against its points (n, 3); world frame, x away from the aisle."""
    tree = cKDTree(points)
    empty = total = 0.0
    for box in shapes.clutter:
        surface, areas = box_surface(box)
        far = np.isinf(tree.query(surface, distance_upper_bound=FAR)[0])
        empty, total = empty + float(areas[far].sum()), total + float(areas.sum())
    fronts = np.array([t.center - [t.radius, 0.0, 0.0] for t in shapes.tomatoes]).reshape(-1, 3)
    inside = len(fronts) and len(shapes.clutter) and (distance_to_shapes(fronts, shapes.clutter) < 0).any(axis=1).mean()
    return {
        "empty_surface": empty / max(total, 1e-9),
        "points_left_out": float((nearest_shapes(points[::5], shapes.shapes, FAR).owner < 0).mean()),
        "fronts_inside": float(inside),
    }


def box_surface(box: Box, spacing: float = 0.01) -> tuple[Array, Array]:
    """Return evenly spaced points (n, 3) on a box's faces and the area (n,) that each represents."""
    points, areas = [], []
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        counts = [max(1, int(np.ceil(2 * box.half_extents[k] / spacing))) for k in others]
        ticks = [(2 * np.arange(n) + 1) / n - 1 for n in counts]
        u, v = (grid.ravel() for grid in np.meshgrid(*ticks))
        for side in (-1.0, 1.0):
            local = np.zeros((len(u), 3))
            local[:, axis], local[:, others[0]], local[:, others[1]] = side, u, v
            points.append(box.center + (local * box.half_extents) @ box.rotation.T)
            areas.append(np.full(len(u), 4 * np.prod(box.half_extents[others]) / len(u)))
    return np.concatenate(points), np.concatenate(areas)
