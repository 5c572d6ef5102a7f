from __future__ import annotations

import numpy as np

from greenhouse_gym.capture.raycast import tessellate
from greenhouse_gym.crops import PlantRow, grow_row
from greenhouse_gym.crops.organs import Organ
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.crops.truth_shapes import truth_of
from greenhouse_gym.geometry import Box, Capsule, Sphere, distance_to_shapes


def test_a_row_of_shapes_is_its_own_truth() -> None:
    row = grow_row(1, 0.5)
    assert truth_of(row) is row


def test_organs_become_shapes_to_collide_with() -> None:
    square = np.array([[0, 0, 1], [0.1, 0, 1], [0.1, 0.02, 1], [0, 0.02, 1]], dtype=float)
    triangles, colors = np.array([[0, 1, 2], [0, 2, 3]]), np.full((2, 3), 0.5)
    axis = np.array([[0, 0, 1.0, 0.003], [0, 0.1, 1.1, 0.002], [0, 0.2, 1.1, 0.002]])
    corners, sides, _ = tessellate([Box([0.5, 0, 0.5], [0.1, 1.0, 0.05], np.eye(3))])
    organs = (
        Organ("leaf", square, triangles, colors),
        Organ("petiole", square, triangles, colors, axis=axis),
        Organ("gutter", corners, sides, np.full((len(sides), 3), 0.5)),
    )
    fruit = Tomato(Sphere([0, 0, 2], 0.03), truss=0)
    truth = truth_of(PlantRow((fruit,), (), (), 1.0, 0, organs=organs))
    assert truth.tomatoes == (fruit,)
    assert [type(shape) for shape in truth.clutter] == [Box, Capsule, Capsule, Box]
    assert distance_to_shapes(square, truth.clutter[:1]).max() < 1e-6
