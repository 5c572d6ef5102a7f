"""Rows of Helios' organ meshes: what they are made of, and that the rest of the sensing side takes them."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from greenhouse_gym.capture import simulate_recording
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.plants import PlantRow, grow_row
from greenhouse_gym.plants.organs import ORGAN_KINDS, Organ, fruit_ellipsoid, tube

pytest.importorskip("pyhelios")


@pytest.fixture(scope="module")
def row() -> PlantRow:
    return grow_row(1, 0.4, source="helios")


def test_a_row_has_organs_of_every_kind(row: PlantRow) -> None:
    assert {organ.kind for organ in row.organs} == set(ORGAN_KINDS)
    assert row.behind is not None
    assert row.behind.organs


def test_tomatoes_lie_in_their_meshes(row: PlantRow) -> None:
    fruits = {organ.fruit: organ for organ in row.organs if organ.kind == "fruit"}
    assert sorted(fruits) == list(range(len(row.tomatoes)))
    for k, tomato in enumerate(row.tomatoes):
        distance = np.linalg.norm(fruits[k].vertices - tomato.center, axis=1)
        assert distance.min() < tomato.radius < distance.max()
        assert fruits[k].truss == tomato.truss


def test_stems_run_inside_their_meshes(row: PlantRow) -> None:
    peduncles = np.concatenate([organ.vertices for organ in row.organs if organ.kind == "peduncle"])
    for stem in row.stems:
        if stem.kind == "peduncle":
            assert np.linalg.norm(peduncles - stem.start, axis=1).min() < 2 * stem.radius


def test_the_same_call_grows_the_same_row(row: PlantRow) -> None:
    again = grow_row(1, 0.4, source="helios")
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(row.organs, again.organs, strict=True))


def test_an_unknown_source_lists_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match="own, helios"):
        grow_row(1, source="blender")


def test_a_station_shows_fruit_leaves_and_depth(row: PlantRow) -> None:
    frame = simulate_recording(row, seed=1)[2].frames["middle"]
    near = (frame.depth > 0) & (frame.depth < 0.6)
    assert near.mean() > 0.02
    assert frame.color[near].std() > 10


def test_an_ellipsoid_keeps_a_mesh_s_moments() -> None:
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(4000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    triangles = ConvexHull(ball).simplices
    a, b, c = ball[triangles].transpose(1, 0, 2)
    inward = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    triangles[inward] = triangles[inward, ::-1]
    shape = fruit_ellipsoid(ball * [0.02, 0.03, 0.04] + [1.0, 2.0, 3.0], triangles, np.eye(3))
    assert shape.center == pytest.approx([1.0, 2.0, 3.0], abs=1e-4)
    assert shape.semi_axes == pytest.approx([0.02, 0.03, 0.04], rel=0.01)
    assert shape.radius == pytest.approx(0.0288, rel=0.01)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda v, t: (np.where(v == v.max(), np.nan, v), t), "finite"),
        (lambda v, t: (v, t[:, ::-1]), "wind inwards"),
        (lambda v, t: (v, np.where(t == t[0, 0], t[0, 1], t)), "no area"),
        (lambda v, t: (v[:-5], t), "beyond"),
    ],
)
def test_a_broken_mesh_is_refused(spoil, message: str) -> None:  # type: ignore[no-untyped-def]
    vertices, triangles = tube(np.array([[0, 0, 0, 0.01], [0, 0, 0.01, 0.02], [0, 0, 0.03, 0.01]]))
    Organ("fruit", vertices, triangles, np.zeros((len(triangles), 3)))
    vertices, triangles = spoil(vertices, triangles)
    with pytest.raises(InvalidValueError, match=message):
        Organ("fruit", vertices, triangles, np.zeros((len(triangles), 3)))
