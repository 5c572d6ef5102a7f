"""The rows on which benchmarks measure shapes: names, light, and rows reserved for fits."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def rows(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT))
    from benchmarks.sensing import rows

    return rows


def test_rows_in_another_light_have_files_of_their_own(rows: ModuleType) -> None:
    names = [rows.Row(501, 1.0, "helios", light).name for light in (None, *rows.LIGHTS)]
    assert len(set(names)) == len(names)
    assert not any(" " in name for name in names)


def test_a_row_is_photographed_in_its_light(rows: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    lights: list[Any] = []
    monkeypatch.setattr(rows.Row, "grow", lambda self: None)
    monkeypatch.setattr(rows, "simulate_recording", lambda *_, light, **__: lights.append(light))
    rows.Row(501, 1.0, "helios").simulate()
    rows.Row(501, 1.0, "helios", "overcast").simulate()
    assert lights == [None, rows.LIGHTS["overcast"]]


def test_light_hides_nothing(rows: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    grown: list[int] = []

    def once(row: Any, rig: Any, poses: Any) -> Any:
        grown.append(1)
        return rows.VisibleRow(rows.Visibility(*np.ones((3, 2))), (), ())

    monkeypatch.setattr(rows, "visible_row", once)
    monkeypatch.setattr(rows.Row, "grow", lambda self: None)
    monkeypatch.setattr(rows.Row, "poses", lambda self: np.zeros((1, 4, 4)))
    plain = rows.visible_of(rows.Row(501, 1.0, "helios"), tmp_path)
    lit = rows.visible_of(rows.Row(501, 1.0, "helios", "overcast"), tmp_path)
    assert len(grown) == 1
    np.testing.assert_array_equal(plain.tomatoes.in_image, lit.tomatoes.in_image)


def test_nobody_is_fitted_to_what_is_measured(rows: ModuleType) -> None:
    measured, chosen, fitted = map(set, (rows.HELD_OUT_MESHES, rows.CHOICE_MESHES, rows.DRAWN_MESHES))
    assert not measured & chosen
    assert not measured & fitted
    assert not chosen & fitted
