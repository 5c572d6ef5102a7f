"""Shapes survive their conversion to arrays and back; scene files stay the same text."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.crops.parts import SpaceBox, Stem, Tomato
from greenhouse_gym.crops.shape_columns import ShapeColumns
from greenhouse_gym.geometry import Box, Capsule, Ellipsoid, Sphere, rotation_about
from greenhouse_gym.scene import Scene, Shapes
from greenhouse_gym.scene.scene import Provenance

TURN = rotation_about([0.3, 0.5, 0.8], 0.7)
TOMATOES = (
    Tomato(Sphere([0.1, 0.2, 0.3], 0.04), 3, 0.5),
    Tomato(Ellipsoid([0.4, 0.2, 0.3], [0.03, 0.04, 0.05], TURN, 0.03914), 1),
)
STEMS = (Stem([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 0.01, "main"), Stem([0.0, 0.0, 1.0], [0.1, 0.0, 1.0], 0.002, "string"))
CLUTTER = (
    SpaceBox([0.0, 0.0, 2.0], [0.1, 0.1, 0.2], np.eye(3)),
    Box([0.2, 0.0, 1.0], [0.05, 0.1, 0.001], TURN),
    Capsule([0.2, 0.0, 1.0], [0.2, 0.1, 1.0], 0.003),
    Sphere([0.2, 0.0, 1.4], 0.01),
    Box([0.5, 0.0, 0.2], [0.05, 0.9, 0.05], np.eye(3)),
)


def described(shape: Any) -> Any:
    """Return types and values of a shape, or of the shapes in it."""
    if isinstance(shape, tuple):
        return [described(each) for each in shape]
    if hasattr(shape, "__dict__"):
        return type(shape).__name__, {name: described(value) for name, value in sorted(vars(shape).items())}
    return shape.tolist() if isinstance(shape, np.ndarray) else shape


def test_columns_hold_all_that_objects_do() -> None:
    columns = ShapeColumns.of(TOMATOES, STEMS, CLUTTER)
    assert columns.counts == (2, 2, 5)
    assert described(columns.tomatoes()) == described(TOMATOES)
    assert described(columns.stems()) == described(STEMS)
    assert described(columns.clutter()) == described(CLUTTER)
    assert columns.leaves.tolist() == [5, 6, 7]
    with pytest.raises(ValueError, match="read-only"):
        columns.clutter()[1].half_extents[0] = 1.0  # type: ignore[union-attr]
    kept = columns.with_clutter(np.array([False, True, False, True, False]))
    assert described(kept.clutter()) == described((CLUTTER[1], CLUTTER[3]))


@pytest.mark.parametrize("left_out", [(), ("clutter",), ("tomatoes", "stems"), ("tomatoes", "stems", "clutter")])
def test_scenes_of_files_write_the_same_text_whatever_was_asked_of_them(left_out: tuple[str, ...]) -> None:
    parts = {"tomatoes": TOMATOES, "stems": STEMS, "clutter": CLUTTER[1:]}
    given = Scene(name="one", provenance=Provenance(row="r"), **{n: p for n, p in parts.items() if n not in left_out})
    text = given.model_dump_json()
    for touch in ((), ("clutter",), ("stems", "tomatoes"), ("columns", "leaves", "count")):
        read = Scene.parse(text.encode(), "one.json")
        for name in touch:
            getattr(read, name)
        for again in (read, copy.copy(read), copy.deepcopy(read), pickle.loads(pickle.dumps(read))):
            assert again.model_dump_json() == text
    assert described(read.tomatoes) == described(given.tomatoes)
    moved = read.model_copy(update={"stems": ()})
    assert (moved.counts, moved.clutter is read.clutter) == ((read.counts[0], 0, read.counts[2]), True)


def test_boxes_over_space_are_clutter_that_is_no_leaf() -> None:
    shapes = Shapes(tomatoes=TOMATOES, clutter=CLUTTER)
    more = shapes.with_space(ShapeColumns.of(clutter=CLUTTER[1:2]).arrays)
    assert type(more.clutter[-1]) is SpaceBox
    assert more.leaves.tolist() == shapes.leaves.tolist()
    assert more.tomatoes is shapes.tomatoes
    assert len(shapes.clutter) == 5


def test_shapes_of_a_file_are_a_part_of_other_scenes() -> None:
    truth = Shapes(tomatoes=TOMATOES, stems=STEMS, clutter=CLUTTER[1:]).compact()
    scene = Scene(name="one", provenance=Provenance(row="r"), truth=truth)
    assert scene.truth is truth
    assert described(Scene.parse(scene.model_dump_json().encode(), "one").truth.tomatoes) == described(truth.tomatoes)  # type: ignore[union-attr]
