from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from row_helpers import half_cloud
from scipy.spatial import cKDTree

from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError
from greenhouse_gym.geometry.point_clouds import Cloud, merge, voxel_means
from greenhouse_gym.reconstruction import METHODS, TriangleMesh, simplify_points, triangulate
from greenhouse_gym.reconstruction.meshing import check_mesh
from greenhouse_gym.reconstruction.row_files import save_mesh, save_points

pytestmark = pytest.mark.xdist_group("row")


def ball(count: int = 3000, radius: float = 0.05) -> Cloud:
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    uneven = np.random.default_rng(1).normal(radius, 1e-5, (count, 1))
    return Cloud([0.4, 0.1, 1.0] + uneven * normals, np.full((count, 3), 0.5), normals)


def cloud_of(points: np.ndarray) -> Cloud:
    return Cloud(points, np.zeros_like(points), np.tile([0.0, 0.0, 1.0], (len(points), 1)))


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


AWKWARD = {
    "equal": np.ones((500, 3)),
    "three places": np.repeat(np.eye(3), 400, axis=0),
    "on a line": np.outer(np.random.default_rng(0).random(2000), [1.0, 2.0, 3.0]),
    "two clusters far apart": np.random.default_rng(0).normal(0, 1e-3, (3000, 3))
    + np.repeat([[0.0], [1e7]], 1500, axis=0),
    "a grid": np.stack(np.meshgrid(*[np.arange(10.0)] * 3), -1).reshape(-1, 3),
    "an outlier": np.concatenate([ball(2000).points, [[1e6, 0, 0]]]),
    "tiny": 1e-9 * ball(2000).points,
}


@pytest.mark.parametrize("target", [1, 2, 7, 100, 333, 499])
@pytest.mark.parametrize("name", AWKWARD)
def test_awkward_clouds_are_simplified_to_within_five_percent_too(name: str, target: int) -> None:
    points = AWKWARD[name]
    few = simplify_points(cloud_of(points), target)
    assert abs(len(few) - target) <= 0.05 * target
    kept, all_places = ({tuple(point) for point in cloud} for cloud in (few.points, points))
    assert kept <= all_places
    if len(all_places) <= 3:
        assert len(kept) == min(len(all_places), target)  # no place is lost


@settings(max_examples=60, deadline=None)
@given(
    count=st.integers(1, 400),
    clusters=st.integers(1, 5),
    size=st.sampled_from([0.0, 1e-6, 0.01, 1.0]),
    target=st.integers(1, 400),
    seed=st.integers(0, 1000),
)
def test_any_cloud_is_simplified(count: int, clusters: int, size: float, target: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(clusters, 3))[rng.integers(clusters, size=count)] + rng.normal(0, size, (count, 3))
    cloud = cloud_of(points)
    few = simplify_points(replace(cloud, colors=np.arange(3.0 * count).reshape(-1, 3)), target)
    assert abs(len(few) - min(count, target)) <= 0.05 * target
    rows = (few.colors[:, 0] / 3).astype(int)
    assert (np.diff(rows) > 0).all()  # each point once, in the cloud's order
    np.testing.assert_array_equal(few.points, points[rows])


def test_targets_must_be_positive() -> None:
    with pytest.raises(InvalidValueError, match="target"):
        simplify_points(ball(), 0)


@pytest.mark.parametrize("method", METHODS)
def test_meshes_have_no_broken_faces(method: str) -> None:
    few = simplify_points(half_cloud(), 4000)
    mesh = triangulate(few, method, faces=3000)
    assert mesh.vertices.shape[1] == mesh.triangles.shape[1] == 3
    assert 500 < len(mesh.triangles) <= 3000
    check_mesh(mesh)
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
    flat = cloud_of(np.column_stack([np.random.default_rng(0).random((50, 2)), np.zeros(50)]))
    with pytest.raises(InvalidValueError, match="50 points have no alpha shape: they lie in a plane"):
        triangulate(flat, "alpha_shape")
    assert len(triangulate(flat, "ball_pivoting").triangles) > 10


@pytest.mark.parametrize("method", ["ball_pivoting", "poisson"])
@pytest.mark.parametrize("noise", [0.0, 1e-9])
def test_points_that_repeat_each_other_change_little(method: str, noise: float) -> None:
    once = ball(500)
    points = np.repeat(once.points, 5, axis=0)
    points += np.random.default_rng(0).normal(0, noise, points.shape)
    mesh = triangulate(Cloud(points, np.zeros_like(points), np.repeat(once.normals, 5, axis=0)), method, faces=None)
    radii = np.linalg.norm(mesh.vertices - [0.4, 0.1, 1.0], axis=1)
    np.testing.assert_allclose(radii, 0.05, atol=0.003)
    assert areas(mesh).sum() == pytest.approx(4 * np.pi * 0.05**2, rel=0.15)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("scale", "offset"), [(1e-6, 0.0), (1e6, 0.0), (1.0, 1e6)])
def test_meshes_of_any_size_at_any_place(method: str, scale: float, offset: float) -> None:
    plain = ball(1000)
    mesh = triangulate(replace(plain, points=scale * plain.points + offset), method, faces=300)
    assert 100 < len(mesh.triangles) <= 300
    radii = np.linalg.norm((mesh.vertices - offset) / scale - [0.4, 0.1, 1.0], axis=1)
    np.testing.assert_allclose(radii, 0.05, atol=0.005)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("faces", [1, 2, 5, 50])
def test_decimated_to_any_number_of_faces(method: str, faces: int) -> None:
    points = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), -1).reshape(-1, 3)
    normals = np.random.default_rng(0).normal(size=points.shape)
    try:
        mesh = triangulate(Cloud(points, np.zeros_like(points), normals), method, faces)
    except InvalidValueError as error:
        assert f"cannot be decimated to {faces}" in str(error)  # noqa: PT017
        assert faces <= 5
    else:
        assert 1 <= len(mesh.triangles) <= faces


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["points", "normals"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_counted(method: str, name: str, value: float) -> None:
    values = getattr(ball(100), name).copy()
    values[[3, 5, 5, 77], [0, 1, 2, 0]] = value
    broken = replace(ball(100), **{name: values})
    with pytest.raises(InvalidValueError, match=f"3 of 100 {name} are not finite"):
        triangulate(broken, method)
    with pytest.raises(InvalidValueError, match=f"3 of 100 {name} are not finite"):
        simplify_points(broken, 10)


@pytest.mark.parametrize("normals", [np.zeros((1000, 3)), np.zeros((0, 3))])
def test_points_without_normals(normals: np.ndarray) -> None:
    bare = replace(ball(1000), normals=normals)
    for method in ("ball_pivoting", "poisson"):
        with pytest.raises(InvalidValueError, match="1000 points have no normals; only alpha_shape"):
            triangulate(bare, method)
    assert len(triangulate(bare, "alpha_shape").triangles) > 100


def test_normals_need_not_have_unit_length_and_some_may_be_missing() -> None:
    expected = ball(1000)
    normals = expected.normals * np.random.default_rng(0).uniform(0.1, 10, (1000, 1))
    normals[::10] = 0.0
    mesh = triangulate(replace(expected, normals=normals), faces=None)
    assert areas(mesh).sum() == pytest.approx(4 * np.pi * 0.05**2, rel=0.15)
    assert len(mesh.vertices) <= 900


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["equal", "three places"])
def test_a_mesh_needs_four_different_points(method: str, name: str) -> None:
    with pytest.raises(InvalidValueError, match=r"4 points, got [13] different"):
        triangulate(cloud_of(AWKWARD[name]), method)


def test_points_on_a_line_have_no_surface() -> None:
    for method, message in (("ball_pivoting", "no surface in these"), ("alpha_shape", "no alpha shape")):
        with pytest.raises(InvalidValueError, match=message):
            triangulate(cloud_of(AWKWARD["on a line"]), method)


def test_faces_must_be_positive() -> None:
    with pytest.raises(InvalidValueError, match="faces must be at least 1, or None for all, got 0"):
        triangulate(ball(100), faces=0)


@pytest.mark.parametrize(
    ("vertices", "triangles", "fault"),
    [
        ([], [[0, 1, 3]], "1 of 2 faces name vertices that do not exist"),
        ([], [[0, 1, -1]], "1 of 2 faces name vertices that do not exist"),
        ([[5.0, 5, 5]], [], "1 vertices that no face uses"),
        ([[np.nan, 5, 5]], [[0, 1, 3]], "1 vertices that are not finite, 1 faces without area"),
        ([], [[1, 2, 0]], "1 duplicate faces"),
        ([], [[2, 1, 0]], "1 duplicate faces"),
        ([], [[0, 1, 1]], "1 faces without area"),
        ([[2.0, 0, 0]], [[0, 1, 3]], "1 faces without area"),
    ],
)
def test_faults_of_meshes_are_named(vertices: list[list[float]], triangles: list[list[int]], fault: str) -> None:
    sound = TriangleMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    check_mesh(sound)
    broken = TriangleMesh(np.array([*sound.vertices, *vertices]), np.array([*sound.triangles, *triangles]))
    with pytest.raises(InvalidValueError, match=fault):
        check_mesh(broken)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl"])
def test_saved_meshes_open_in_open3d(tmp_path: Path, suffix: str) -> None:
    mesh = triangulate(ball(500), faces=None)
    path = tmp_path / "sub" / f"mesh{suffix}"
    save_mesh(mesh, path)
    read = open3d().io.read_triangle_mesh(str(path))
    assert len(read.triangles) == len(mesh.triangles)
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".xyz"])
def test_saved_points_open_in_open3d(tmp_path: Path, suffix: str) -> None:
    cloud = ball(100)
    path = tmp_path / "sub" / f"cloud{suffix}"
    save_points(cloud, path)
    read = open3d().io.read_point_cloud(str(path))
    np.testing.assert_allclose(read.points, cloud.points, atol=1e-6)
    if suffix != ".xyz":
        np.testing.assert_allclose(read.normals, cloud.normals, atol=1e-6)
        np.testing.assert_allclose(read.colors, cloud.colors, atol=1 / 255)
    assert list(path.parent.iterdir()) == [path]


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
    moved = cloud.transformed(shift)
    np.testing.assert_allclose(moved.points, cloud.points + [1, 2, 3])
    np.testing.assert_array_equal(moved.normals, cloud.normals)
    both = merge([cloud, moved])
    assert len(both) == 20
    np.testing.assert_array_equal(both.select(np.arange(10, 20)).points, moved.points)
    assert len(merge([])) == 0


def test_an_array_is_no_cloud() -> None:
    points: Any = np.random.default_rng(0).uniform(size=(100, 3))
    for make in (triangulate, simplify_points):
        with pytest.raises(InvalidValueError, match="expected a Cloud of points, colors and normals, got ndarray"):
            make(points)
