from __future__ import annotations

from dataclasses import fields
from typing import Any

import pytest

from greenhouse_gym.build.scenes import BuildSettings
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.reconstruction import ReconstructionSettings
from greenhouse_gym.reconstruction.occupancy_carving import CarvingSettings
from greenhouse_gym.shapes import FINE_SHAPES, ShapeSettings

NAN, INFINITE = float("nan"), float("inf")
CLASSES = (BuildSettings, CarvingSettings, ReconstructionSettings, ShapeSettings)
LENGTHS = (
    *((ShapeSettings, name) for name in ("voxel", "fine_voxel")),
    *((ReconstructionSettings, name) for name in ("voxel", "foreground", "fine_distance", "max_rmse")),
    *((BuildSettings, name) for name in ("spacing", "width", "reach", "leaf_tolerance")),
    (CarvingSettings, "voxel"),
)


@pytest.mark.parametrize("kind", CLASSES)
def test_every_number_of_every_class_is_looked_at(kind: Any) -> None:
    kinds = ("float", "int", "Positive", "Fraction", "Count", "PositiveCount")
    numbers = [field for field in fields(kind) if str(field.type).partition(" ")[0] in kinds]
    assert numbers
    for field in numbers:
        for value in (NAN, INFINITE, -1, "7", [1]):
            with pytest.raises(InvalidValueError, match=f"^{field.name}: Input should be .*, got "):
                kind(**{field.name: value})


@pytest.mark.parametrize(("kind", "name"), LENGTHS)
def test_lengths_without_a_size_are_refused(kind: Any, name: str) -> None:
    with pytest.raises(InvalidValueError, match=f"^{name}: Input should be greater than 0, got 0.0"):
        kind(**{name: 0.0})


@pytest.mark.parametrize("name", ["radii", "small_radii", "pipe_radii", "stem_radii"])
@pytest.mark.parametrize(
    "ends",
    [(0.012, 0.004), (0.01, 0.01), (0.0, 0.01), (-0.01, 0.01), (0.01, NAN), (0.01, INFINITE), (0.01,), 0.01],
)
def test_ranges_that_do_not_go_up_are_refused(name: str, ends: Any) -> None:
    with pytest.raises(InvalidValueError, match=f"^{name}: .*, got "):
        ShapeSettings(**{name: ends})


def test_none_is_for_fields_that_can_do_without() -> None:
    assert ShapeSettings(small_radii=None).small_radii is None
    assert BuildSettings(max_targets=None).max_targets is None
    others: list[tuple[Any, str]] = [(ShapeSettings, "radii"), (ShapeSettings, "voxel"), (BuildSettings, "max_shapes")]
    for kind, name in others:
        with pytest.raises(InvalidValueError, match=f"^{name}: Input should be .*, got None"):
            kind(**{name: None})


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (
            ReconstructionSettings,
            {"calibration_stations": -1},
            "calibration_stations: Input should be greater than or equal to 0, got -1",
        ),
        (
            ReconstructionSettings,
            {"calibration_stations": 1.5},
            "calibration_stations: Input should be a valid integer, got 1.5",
        ),
        (
            ReconstructionSettings,
            {"calibration_stations": True},
            "calibration_stations: Input should be a valid integer, got True",
        ),
        (ReconstructionSettings, {"min_overlap": 1.2}, "min_overlap: Input should be less than or equal to 1, got 1.2"),
        (ReconstructionSettings, {"links": (1,)}, "links: Input should be greater than or equal to 2, got (1,)"),
        (
            ReconstructionSettings,
            {"step_range": (0.2, 0.1)},
            "step_range: Input should be two ascending numbers, got (0.2, 0.1)",
        ),
        (ReconstructionSettings, {"calibrate_edges": 1}, "calibrate_edges: Input should be a valid boolean, got 1"),
        (CarvingSettings, {"aisle": "no"}, "aisle: Input should be a valid boolean, got 'no'"),
        (BuildSettings, {"max_targets": 0}, "max_targets: Input should be greater than 0, got 0"),
        (ShapeSettings, {"min_confidence": 40}, "min_confidence: Input should be less than or equal to 1, got 40"),
    ],
)
def test_other_values_that_make_no_sense(kind: Any, values: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidValueError) as refused:
        kind(**values)
    assert str(refused.value).startswith(message)


def test_unknown_sources_of_station_poses_are_named() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown source of station poses 'guess'.*estimate, given, refine"):
        ReconstructionSettings(poses="guess")  # type: ignore[arg-type]


def test_whole_numbers_do_where_fractions_are_meant() -> None:
    assert BuildSettings(width=2).width == 2
    assert ReconstructionSettings(step_range=(0, 1)).step_range == (0, 1)
    assert FINE_SHAPES.clutter_merge_area == 0
