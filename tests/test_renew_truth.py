"""The script that gives the shipped scenes another truth, on a row of which it is known where it stands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from greenhouse_gym.build.scenes import BuildSettings, truth_in_scene
from greenhouse_gym.crops import PlantRow, grow_row
from greenhouse_gym.geometry import pose, rotation_about
from greenhouse_gym.scene import ArmPlacement, Provenance, Scene

Find = Callable[[PlantRow, Scene], np.ndarray]


@pytest.fixture
def frame_of(monkeypatch: pytest.MonkeyPatch) -> Find:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    import renew_truth

    return renew_truth.frame_of


@pytest.fixture(scope="module")
def row() -> PlantRow:
    return grow_row(3, 1.0, 2)


def scene_in(row: PlantRow, frame: np.ndarray) -> Scene:
    truth = truth_in_scene(row, frame, BuildSettings())
    known = Provenance(row="a row")
    return Scene(
        name="there",
        tomatoes=truth.tomatoes,
        stems=(),
        clutter=(),
        placement=ArmPlacement(),
        truth=truth,
        provenance=known,
    )


def test_a_row_is_found_where_a_scene_has_it(row: PlantRow, frame_of: Find) -> None:
    frame = pose(rotation_about([0.1, 0.2, 1.0], 0.3), [0.2, -0.4, 0.05])
    np.testing.assert_allclose(frame_of(row, scene_in(row, frame)), frame, atol=1e-4)


def test_another_row_is_refused(row: PlantRow, frame_of: Find) -> None:
    scene = scene_in(row, pose(translation=[0.1, -0.4, 0.0]))
    moved = [tomato.transformed(pose(translation=[0.0, 0.0, 0.001 * k])) for k, tomato in enumerate(row.tomatoes)]
    with pytest.raises(SystemExit, match=r"there: its tomatoes are not those of the row, .* mm apart"):
        frame_of(replace(row, tomatoes=tuple(moved)), scene)
    with pytest.raises(SystemExit, match="there: 0 of its tomatoes are told apart"):
        frame_of(replace(row, tomatoes=()), scene)
