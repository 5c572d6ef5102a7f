from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.geometry import Array, rotation_about
from greenhouse_gym.shapes import extract_shapes
from greenhouse_gym.shapes.input_checks import ShapeWarning

FOLDER = Path(os.environ.get("GREENHOUSE_GYM_REAL_DATA", "/nonexistent"))
needs_data = pytest.mark.skipif(not FOLDER.is_dir(), reason="GREENHOUSE_GYM_REAL_DATA names no folder with real clouds")


@pytest.fixture
def real(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The benchmark's module."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))
    from benchmarks.sensing import real_data

    return real_data


def half_can(radius: float = 0.035) -> Array:
    """The visible half of an upright can at (0.7, 0, 0), 12 cm high, with a millimetre of noise."""
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(np.pi / 2, 3 * np.pi / 2, 3000), rng.uniform(0.0, 0.12, 3000)
    r = radius + rng.normal(0, 0.001, 3000)
    return np.column_stack([0.7 + r * np.cos(angle), r * np.sin(angle), height])


def upright(radius: float = 0.035, tilt: float = 0.0) -> Stem:
    middle = np.array([0.7, 0.0, 0.06])
    half = rotation_about([1, 0, 0], tilt) @ [0.0, 0.0, 0.06]
    return Stem(middle - half, middle + half, radius, "main")


def test_a_cylinder_is_fitted_to_one_side_of_it(real: Any) -> None:
    can = real.fit_cylinder(half_can())
    assert can.radius == pytest.approx(0.035, abs=5e-4)
    assert abs(real.direction(can)[2]) > 0.999
    np.testing.assert_allclose(can.start[:2], [0.7, 0.0], atol=1e-3)
    assert can.length == pytest.approx(0.12, abs=0.003)


def test_a_can_is_measured_by_the_stem_that_explains_it(real: Any) -> None:
    elsewhere = Stem([0, 0, 0], [0, 0, 1], 0.01, "main")
    right = real.measure_can(half_can(), [elsewhere, upright()])
    assert right["found"]
    assert right["radius_residual"] < 0.001
    assert right["axis_angle"] < 0.02
    assert real.measure_can(half_can(), [upright(0.040)])["radius_residual"] == pytest.approx(0.005, abs=5e-4)
    assert real.measure_can(half_can(), [upright(tilt=0.1)])["axis_angle"] == pytest.approx(0.1, abs=0.01)
    assert not real.measure_can(half_can(), [elsewhere])["found"]
    assert not real.measure_can(half_can(), [])["found"]


def test_false_length_is_what_lies_away_from_labeled_points(real: Any) -> None:
    points = half_can()
    assert real.false_length([upright()], points) == 0.0
    assert real.false_length([Stem([0, 0, 0], [0, 0, 0.12], 0.01, "main"), upright()], points) == pytest.approx(0.5)
    assert np.isnan(real.false_length([], points))


def test_a_main_stem_is_the_skeleton_up_to_the_first_fork(real: Any) -> None:
    nodes = np.array([[0, 0, 1], [0, 0, 0], [0, 0, 2], [1, 0, 3], [-1, 0, 3], [0, 1, 2.5]], dtype=float)
    edges = nodes[[(3, 2), (0, 1), (2, 4), (2, 0), (2, 5)]]
    np.testing.assert_array_equal(real.to_first_fork(edges), nodes[[(1, 0), (0, 2)]])
    np.testing.assert_array_equal(
        real.to_first_fork(nodes[[(0, 2), (1, 0)]]), nodes[[(1, 0), (0, 2)]]
    )  # no fork at all


def test_slices_follow_a_stem(real: Any) -> None:
    stem = np.column_stack([np.linspace(0, 0.1, 1000), np.zeros(1000), np.linspace(0, 0.2, 1000)])
    line = real.chain(real.slice_means(stem))
    assert len(line) == 20
    np.testing.assert_allclose(line[:, 0, 0], line[:, 0, 2] / 2)


@needs_data
@pytest.mark.parametrize("name", ["learn33", "test50"])
def test_real_cans_and_mugs_become_pipes(real: Any, name: str) -> None:
    scene = real.read_table(FOLDER, name)
    cans = scene.points[np.isin(scene.labels, real.CYLINDERS[name])]
    near = ((scene.points > cans.min(axis=0) - 0.05) & (scene.points < cans.max(axis=0) + 0.05)).all(axis=1)
    cans, others = real.measure_table(
        replace(scene, **{part: getattr(scene, part)[near] for part in ("points", "colors", "normals", "labels")})
    )
    assert len(cans) == 2
    for can in cans.values():
        assert can["found"]
        assert can["radius_residual"] < 0.002
        assert can["axis_angle"] < 0.05
    assert others["other_pipes"] == 0
    assert others["tomatoes"] <= 1  # a red bowl


@needs_data
def test_the_main_stem_of_a_scanned_seedling_is_found(real: Any) -> None:
    seedlings = sorted(real.read_seedlings(FOLDER, real.SEEDLING_HEIGHT), key=lambda plant: -len(plant.points))
    plants = {plant.name[:3]: plant for plant in seedlings}
    assert sorted(plants) == ["03-", "BFS"]
    for plant in plants.values():  # the smallest of either kind: one with a skeleton, one with labels
        labels = None if plant.labels is None else plant.labels[::2]
        thin = replace(plant, points=plant.points[::2], colors=plant.colors[::2], labels=labels)
        compared, figures = real.measure_seedling(thin)
        assert compared.visible > 0.2
        assert figures["recall"] == compared.recall > 0.5


@needs_data
def test_apples_under_the_noise_of_a_real_sensor_are_found_in_their_size(real: Any) -> None:
    frame = real.read_orchard(FOLDER)
    part = (np.abs(frame.cloud.points[:, 1] - 0.5) < 0.25) & (np.abs(frame.cloud.points[:, 2] - 0.3) < 0.35)
    cloud = frame.cloud.select(part)  # holds four labeled apples
    with pytest.warns(ShapeWarning, match="unlike those the networks were fitted to: its normals vary"):
        shapes = extract_shapes(cloud.points, cloud.colors, cloud.normals)
    assert not [stem for stem in shapes.stems if stem.kind in ("peduncle", "pedicel")]
    figures = real.measure_orchard(frame, shapes)
    assert figures["hit"] >= 3
    assert figures["right_size"] >= 3
    assert figures["red"] >= 0.85
    assert figures["spheres"] <= 12
