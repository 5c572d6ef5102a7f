from __future__ import annotations

import base64
import json
import lzma
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import make_scene, with_ellipsoids
from hypothesis import given
from hypothesis import strategies as st

from greenhouse_gym.crops import grow_row
from greenhouse_gym.crops.shape_tables import (
    COLUMNS,
    ShapeTables,
    as_tables,
    from_tables,
    select_near,
    transform_tables,
)
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.geometry import (
    Box,
    Capsule,
    distance_to_shapes,
    invert,
    pose,
    quaternions_from,
    rotation_about,
    rotations_from,
    transform,
)
from greenhouse_gym.scene import Scene, Shapes
from greenhouse_gym.scene.shape_lists import _decode, _encode


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.01), st.floats(-4, 4))
def test_quaternions_are_the_rotations(axis: list[float], angle: float) -> None:
    rotation = rotation_about(axis, angle)
    quaternion = quaternions_from(rotation)
    assert np.linalg.norm(quaternion) == pytest.approx(1.0)
    np.testing.assert_allclose(rotations_from(quaternion)[0], rotation, atol=1e-12)


def a_bit_of_everything() -> Shapes:
    scene = with_ellipsoids(make_scene(0), 0)
    turn = rotation_about([1.0, 2.0, 3.0], 2.9)
    clutter = (*scene.clutter, Capsule([0, 0, 1], [0.1, 0, 1], 0.01), Box([0, 1, 2], [0.1, 3.2, 0.001], turn))
    return Shapes(tomatoes=scene.tomatoes, stems=scene.stems, clutter=clutter)


def values(shapes: Any) -> list[Any]:
    return [
        (type(s).__name__, *(np.asarray(v, dtype=object).tolist() for v in vars(s).values()))
        for s in (
            *(tomato.shape for tomato in shapes.tomatoes),
            *shapes.stems,
            *sorted(shapes.clutter, key=lambda s: type(s).__name__),
        )
    ]


def test_tables_keep_everything() -> None:
    shapes = a_bit_of_everything()
    again = from_tables(as_tables(shapes.tomatoes, shapes.stems, shapes.clutter))
    for one, other in zip(values(shapes), values(again), strict=True):
        assert one[0] == other[0]
        for a, b in zip(one[1:], other[1:], strict=True):
            assert a == b or np.abs(np.array(a) - np.array(b)).max() < 1e-9
    assert from_tables(as_tables((), (), ())) == ((), (), ())


def test_tables_move_as_their_shapes_do() -> None:
    shapes = a_bit_of_everything()
    frame = pose(rotation_about([1.0, 0.5, -2.0], 0.7), [1.0, 2.0, 3.0])
    there = from_tables(transform_tables(as_tables(shapes.tomatoes, shapes.stems, shapes.clutter), frame))
    points = np.random.default_rng(0).uniform(-1, 2, (50, 3))
    before, after = shapes.obstacles, there.shapes
    order = [*range(len(before) - len(shapes.clutter))]
    order += sorted(
        range(len(order), len(before)), key=lambda k: ("Sphere", "Capsule", "Box").index(type(before[k]).__name__)
    )
    expected = distance_to_shapes(points, [before[k] for k in order])
    np.testing.assert_allclose(distance_to_shapes(transform(frame, points), after), expected, atol=1e-9)
    back = transform_tables(transform_tables(as_tables(*shapes_of(shapes)), frame), invert(frame))
    for one, other in zip(back, as_tables(*shapes_of(shapes)), strict=True):
        np.testing.assert_allclose(np.abs(one), np.abs(other), atol=1e-9)  # q and -q are one rotation


def test_nothing_near_is_lost() -> None:
    shapes = a_bit_of_everything()
    tables = as_tables(*shapes_of(shapes))
    for reach in (0.05, 0.3, 1.0):
        point = np.array([0.5, 0.1, 1.0])
        kept = from_tables(select_near(tables, point, reach))
        count = sum(map(len, kept))
        least = int((distance_to_shapes(point[None], shapes.obstacles)[0] < reach).sum())
        assert least <= count <= len(shapes.obstacles)
        found = distance_to_shapes(point[None], kept.shapes)[0]
        assert int((found < reach).sum()) == least
    assert count < len(shapes.obstacles) or reach == 1.0


def shapes_of(shapes: Shapes) -> tuple[Any, Any, Any]:
    return shapes.tomatoes, shapes.stems, shapes.clutter


def test_a_file_keeps_truth_to_a_tenth_of_a_millimetre_and_then_for_good(tmp_path: Path) -> None:
    scene = make_scene(0).model_copy(update={"truth": a_bit_of_everything()})
    loaded = Scene.load(scene.save(tmp_path / "scene.json"))
    assert loaded.truth is not None
    assert scene.truth is not None
    for one, other in zip(values(scene.truth), values(loaded.truth), strict=True):
        for a, b in zip(one[1:], other[1:], strict=True):
            assert a == b or np.abs(np.array(a) - np.array(b)).max() < 6e-4
    assert values(scene.truth.compact()) == values(loaded.truth)
    again = loaded.save(tmp_path / "again.json")
    assert again.read_bytes() == loaded.save(tmp_path / "third.json").read_bytes()
    assert values(Scene.load(again).truth) == values(loaded.truth)


def xz_of(data: bytes, dict_size: int = 2**20) -> str:
    filters = [{"id": lzma.FILTER_LZMA2, "preset": 6, "dict_size": dict_size}]
    return base64.b64encode(lzma.compress(data, filters=filters)).decode()


@pytest.mark.parametrize("kinds", COLUMNS)
@given(data=st.data())
def test_encoded_tables_are_decoded_exactly(kinds: str, data: st.DataObject) -> None:
    """Of any numbers, whether or not four of them are a unit quaternion."""
    rows = data.draw(st.integers(0, 5))
    values = data.draw(st.lists(st.integers(-(10**8), 10**8), min_size=rows * len(kinds), max_size=rows * len(kinds)))
    table = np.array(values, dtype=np.int64).reshape(rows, len(kinds))
    encoded = _encode(table, kinds)
    assert encoded.shape == (rows, len(kinds) + ("q" in kinds))
    np.testing.assert_array_equal(_decode(encoded, kinds), table)


def test_a_quaternion_of_a_fifth_entry_is_refused() -> None:
    encoded = np.zeros((2, 8), dtype=np.int64)
    encoded[1, -2] = 8
    with pytest.raises(InvalidValueError, match="quaternion"):
        _decode(encoded, "xxxqqqq")


def test_truth_written_as_lists_still_loads(tmp_path: Path) -> None:
    scene = make_scene(0)
    data = scene.model_dump(mode="json")
    data["truth"] = {"tomatoes": data["tomatoes"], "stems": [], "clutter": []}
    path = tmp_path / "old.json"
    path.write_text(json.dumps(data))
    truth = Scene.load(path).truth
    assert truth is not None
    assert len(truth.tomatoes) == len(scene.tomatoes)


def test_a_grown_rows_truth_is_small() -> None:
    row = grow_row(1, 2.0)
    shapes = Shapes(tomatoes=row.tomatoes, stems=row.stems, clutter=row.clutter)  # type: ignore[arg-type]
    size = len(json.dumps(make_scene(0).model_copy(update={"truth": shapes}).model_dump(mode="json")["truth"]))
    assert len(shapes.obstacles) > 1000
    assert size < 30 * len(shapes.obstacles)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"xz": "%%%"}, "damaged"),
        ({"xz": "AAAA"}, "damaged"),
        ({"xz": 3}, "damaged"),
        ({"xz": xz_of(bytes(10**6))}, "expected [0-9]+ bytes"),
        ({"xz": xz_of(b"", dict_size=2**28)}, "damaged"),
        ({"rows": {}}, "rows"),
        ({"rows": dict.fromkeys(ShapeTables._fields, 10**9)}, "in all"),
        ({"rows": dict.fromkeys(ShapeTables._fields, -1)}, "in all"),
        ({"rows": dict.fromkeys(ShapeTables._fields, 7)}, "damaged"),
    ],
)
def test_damaged_truth_is_named(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    data = make_scene(0).model_copy(update={"truth": a_bit_of_everything()}).model_dump(mode="json")
    data["truth"].update(change)
    path = tmp_path / "damaged.json"
    path.write_text(json.dumps(data))
    with pytest.raises(FileFormatError, match=f"truth.*{message}"):
        Scene.load(path)


@pytest.mark.parametrize(("table", "column", "value"), [("boxes", 3, -1.0), ("boxes", 0, np.nan), ("stems", 7, 9.0)])
def test_impossible_tables_are_refused(table: str, column: int, value: float) -> None:
    shapes = a_bit_of_everything()
    tables = as_tables(shapes.tomatoes, shapes.stems, shapes.clutter)
    getattr(tables, table)[0, column] = value
    with pytest.raises(InvalidValueError):
        from_tables(tables)
    with pytest.raises(InvalidValueError, match="columns"):
        from_tables(tables._replace(spheres=np.zeros((2, 5))))
