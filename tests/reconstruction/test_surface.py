from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from row_helpers import half_cloud
from scipy.spatial import cKDTree

from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError
from greenhouse_gym.open3d_loader import open3d
from greenhouse_gym.reconstruction import METHODS, TriangleMesh, simplify_points, triangulate
from greenhouse_gym.reconstruction.clouds import Cloud, merge, voxel_means
from greenhouse_gym.reconstruction.surface import save_mesh, save_points

pytestmark = pytest.mark.xdist_group("row")


def ball(count: int = 3000, radius: float = 0.05) -> Cloud:
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    uneven = np.random.default_rng(1).normal(radius, 1e-5, (count, 1))
    return Cloud([0.4, 0.1, 1.0] + uneven * normals, np.full((count, 3), 0.5), normals)


def areas(mesh: TriangleMesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


@pytest.mark.parametrize("target", [100, 1000, 10_000, 20_000])
def test_simplified_to_within_five_percent(target: int) -> None:
    row = half_cloud()
    few = simplify_points(row, target)
    assert len(few) == pytest.approx(target, rel=0.05)
    assert len(few.station) == len(few.colors) == len(few.normals) == len(few)
    distance, where = cKDTree(row.points).query(few.points)
    assert distance.max() == 0.0  # real points
    np.testing.assert_array_equal(few.colors, row.colors[where])
    np.testing.assert_array_equal(few.station, row.station[where])
    np.testing.assert_array_equal(few.world_from_station, row.world_from_station)


def test_simplified_evenly() -> None:
    few = simplify_points(ball(), 300)
    gaps = cKDTree(few.points).query(few.points, k=2)[0][:, 1]
    assert np.median(gaps) == pytest.approx(np.sqrt(4 * np.pi * 0.05**2 / 300), rel=0.4)


def test_fewer_points_than_the_target_come_back_unchanged() -> None:
    row = half_cloud()
    assert simplify_points(row, len(row)) is row
    assert simplify_points(row, 10 * len(row)) is row


def test_equal_points_become_one() -> None:
    same = Cloud(np.ones((50, 3)), np.zeros((50, 3)), np.tile([0.0, 0.0, 1.0], (50, 1)))
    few = simplify_points(same, 10)
    assert 1 <= len(few) <= 10
    assert (few.points == 1.0).all()


def test_targets_must_be_positive() -> None:
    with pytest.raises(InvalidValueError, match="target"):
        simplify_points(ball(), 0)


@pytest.mark.parametrize("method", METHODS)
def test_meshes_have_no_broken_faces(method: str) -> None:
    few = simplify_points(half_cloud(), 4000)
    mesh = triangulate(few, method, faces=3000)
    assert mesh.vertices.shape[1] == mesh.triangles.shape[1] == 3
    assert np.isfinite(mesh.vertices).all()
    assert 500 < len(mesh.triangles) <= 3000
    assert mesh.triangles.min() >= 0
    assert mesh.triangles.max() < len(mesh.vertices)
    a, b, c = mesh.triangles.T
    assert not ((a == b) | (b == c) | (a == c)).any()
    assert (areas(mesh) > 0).all()
    first = mesh.triangles.argmin(axis=1)[:, None] + [0, 1, 2]
    turned = np.take_along_axis(mesh.triangles, first % 3, axis=1)
    assert len(np.unique(turned, axis=0)) == len(mesh.triangles)  # none is there twice
    assert len(np.unique(mesh.triangles)) == len(mesh.vertices)  # none is left over
    tree = cKDTree(few.points)
    spacing = np.median(tree.query(few.points, k=2)[0][:, 1])
    assert np.quantile(tree.query(mesh.vertices)[0], 0.95) < 3.5 * spacing  # it stays near the points


@pytest.mark.parametrize("method", METHODS)
def test_meshes_of_a_ball(method: str) -> None:
    mesh = triangulate(ball(), method, faces=None)
    radii = np.linalg.norm(mesh.vertices - [0.4, 0.1, 1.0], axis=1)
    np.testing.assert_allclose(radii, 0.05, atol=0.003)
    assert areas(mesh).sum() == pytest.approx(4 * np.pi * 0.05**2, rel=0.15 if method != "alpha_shape" else 1.2)
    few = triangulate(ball(), method, faces=200)
    assert 50 < len(few.triangles) <= 200 < len(mesh.triangles)


def test_an_unknown_method_lists_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match=r"'poison'.*Did you mean 'poisson'.*ball_pivoting"):
        triangulate(ball(), "poison")


def test_a_mesh_needs_four_points() -> None:
    with pytest.raises(InvalidValueError, match="4 points, got 3"):
        triangulate(ball(3))


def test_points_in_a_plane_have_no_alpha_shape() -> None:
    points = np.column_stack([np.random.default_rng(0).random((50, 2)), np.zeros(50)])
    flat = Cloud(points, np.zeros((50, 3)), np.tile([0.0, 0.0, 1.0], (50, 1)))
    with pytest.raises(InvalidValueError, match="no alpha shape"):
        triangulate(flat, "alpha_shape")
    assert len(triangulate(flat, "ball_pivoting").triangles) > 10


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl"])
def test_saved_meshes_open_in_open3d(tmp_path: Path, suffix: str) -> None:
    mesh = triangulate(ball(500), faces=None)
    path = tmp_path / "sub" / f"mesh{suffix}"
    save_mesh(mesh, path)
    read = open3d().io.read_triangle_mesh(str(path))
    assert len(read.triangles) == len(mesh.triangles)
    assert list(path.parent.iterdir()) == [path]


def test_saved_points_open_in_open3d(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    save_points(ball(100), path)
    np.testing.assert_allclose(np.asarray(open3d().io.read_point_cloud(str(path)).points), ball(100).points, atol=1e-6)


def test_an_unknown_suffix_keeps_the_folder_clean(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"mesh\.docx: could not be written"):
        save_mesh(triangulate(ball(100), faces=None), tmp_path / "mesh.docx")
    assert list(tmp_path.iterdir()) == []


# -- clouds -----------------------------------------------------------------------------------------------------------


def test_voxel_means() -> None:
    points = np.array([[0.0, 0, 0], [0.5, 0, 0], [1.2, 0, 0], [0.1, 0.1, 3.0]])
    cloud = Cloud(points, points / 3, np.tile([0.0, 0.0, 1.0], (4, 1)))
    means, cube = voxel_means(cloud, 1.0)
    assert len(means) == 3
    np.testing.assert_array_equal(cube[:2], cube[0])
    np.testing.assert_allclose(means.points[cube[0]], [0.25, 0, 0])
    np.testing.assert_allclose(means.colors[cube[3]], points[3] / 3)
    np.testing.assert_allclose(means.normals, cloud.normals[:3])


def test_clouds_move_select_and_merge() -> None:
    cloud = ball(10)
    shift = np.eye(4)
    shift[:3, 3] = [1, 2, 3]
    moved = cloud.moved(shift)
    np.testing.assert_allclose(moved.points, cloud.points + [1, 2, 3])
    np.testing.assert_array_equal(moved.normals, cloud.normals)
    both = merge([cloud, moved])
    assert len(both) == 20
    np.testing.assert_array_equal(both.select(np.arange(10, 20)).points, moved.points)
    assert len(merge([])) == 0
