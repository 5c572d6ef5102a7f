from __future__ import annotations

import numpy as np
import pytest
from row_helpers import HALF, grown

from greenhouse_gym.capture.raycast import RowRaycaster, tessellate
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Box, Capsule, Ellipsoid, Shape, Sphere, distance_to_shapes, pose, rotation_about

TURN = rotation_about([1, 2, 3], 0.7)
R, L = 0.03, 0.2
SHAPES: list[tuple[Shape, float, float]] = [
    (Sphere([0.1, 0.2, 0.3], R), 4 / 3 * np.pi * R**3, 4 * np.pi * R**2),
    (Capsule([0, 0, 0], L * TURN[:, 0], R), np.pi * R**2 * (L + 4 / 3 * R), 2 * np.pi * R * (L + 2 * R)),
    (Capsule([0, 0, L], [0, 0, 0], 0.005), np.pi * 0.005**2 * (L + 0.02 / 3), 2 * np.pi * 0.005 * (L + 0.01)),
    (Capsule([1, 1, 1], [1, 1, 1], R), 4 / 3 * np.pi * R**3, 4 * np.pi * R**2),
    (
        Ellipsoid([0, 0, 1], [R, R, R], TURN),
        4 / 3 * np.pi * R**3,
        4 * np.pi * R**2,
    ),
    (
        Ellipsoid([0, 0, 1], [0.8 * R, R, R / 0.8], TURN),
        4 / 3 * np.pi * R**3,
        4 * np.pi * 1.0175 * R**2,
    ),
    (Box([0.1, 0, 0], [0.1, 0.2, 0.3], TURN), 8 * 0.006, 8 * (0.02 + 0.03 + 0.06)),
]


@pytest.mark.parametrize(("shape", "volume", "area"), SHAPES)
def test_volume_and_area_are_close_to_the_analytic_ones(shape: Shape, volume: float, area: float) -> None:
    vertices, triangles, owner = tessellate([shape])
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    # the round ends of capsules have few rings; those of a row are long and thin
    tolerance = (
        1e-9
        if isinstance(shape, Box)
        else 0.02
        if isinstance(shape, Sphere | Ellipsoid)
        else 0.05
        if shape.length
        else 0.1
    )
    # a positive volume by the divergence theorem also says that the mesh is closed and turned outwards
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(volume, rel=tolerance)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(area, rel=tolerance)
    assert (owner == 0).all()


@pytest.mark.parametrize("shape", [entry[0] for entry in SHAPES])
def test_vertices_lie_near_the_surface(shape: Shape) -> None:
    vertices, _, _ = tessellate([shape])
    size = 0.0 if isinstance(shape, Box) else shape.radius
    assert np.abs(distance_to_shapes(vertices, [shape])).max() < 0.03 * size + 1e-9


def test_every_triangle_knows_its_shape() -> None:
    shapes = [entry[0] for entry in SHAPES]
    vertices, triangles, owner = tessellate(shapes)
    assert triangles.max() == len(vertices) - 1
    middles = vertices[triangles].mean(axis=1)
    distance = np.abs(distance_to_shapes(middles, shapes))
    assert (distance[np.arange(len(owner)), owner] < 0.002).all()
    assert set(owner) == set(range(len(shapes)))


def test_depth_is_along_the_optical_axis() -> None:
    ball = Tomato(Sphere([0.5, 0.0, 1.1], 0.04), truss=0, ripeness=1.0)
    beside = Tomato(Sphere([0.5, 0.15, 1.2], 0.04), truss=0, ripeness=0.0)
    caster = RowRaycaster.of(PlantRow((ball, beside), (), (), 1.0, 0))
    camera = HALF.cameras["middle"]
    view = caster.render(camera.rig_from_camera, camera.intrinsics)
    assert view.depth[view.shape == 0].min() == pytest.approx(0.46, abs=5e-4)
    assert view.depth[view.shape == 1].min() == pytest.approx(0.46, abs=2e-3)  # not the length of the ray
    rows, columns = np.nonzero(view.shape == 0)  # pixels are counted from their centers
    assert (columns.min() + columns.max()) / 2 == pytest.approx(camera.intrinsics.cx, abs=0.01)
    assert (rows.min() + rows.max()) / 2 == pytest.approx(camera.intrinsics.cy, abs=0.01)
    assert np.isinf(view.depth[view.shape == -1]).all()
    assert np.median(view.color[view.shape == 0], axis=0)[0] > 100  # red
    assert np.argmax(np.median(view.color[view.shape == 1], axis=0)) == 1  # green


def test_shapes_are_numbered_tomatoes_stems_clutter_row_behind() -> None:
    row = grown()
    assert row.behind is not None
    shapes = [*row.shapes]
    shapes += row.behind.shapes
    camera = HALF.cameras["middle"]
    world_from_camera = pose(translation=[0.0, 0.25, 0.0]) @ camera.rig_from_camera
    view = RowRaycaster.of(row).render(world_from_camera, camera.intrinsics)
    rows, columns = np.nonzero(view.shape >= 0)
    chosen = np.random.default_rng(0).choice(len(rows), 2000, replace=False)
    rows, columns = rows[chosen], columns[chosen]
    k, z = camera.intrinsics, view.depth[rows, columns].astype(float)
    points = np.column_stack([(columns - k.cx) / k.fx * z, (rows - k.cy) / k.fy * z, z])
    points = points @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
    owners = view.shape[rows, columns]
    own = [abs(distance_to_shapes(p[None], [shapes[i]])[0, 0]) for p, i in zip(points, owners, strict=True)]
    assert np.quantile(own, 0.99) < 0.002
    assert max(own) < 0.01
