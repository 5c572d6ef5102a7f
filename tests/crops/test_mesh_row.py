"""Rows of Helios' organ meshes: what they are made of, and that the rest of the sensing side takes them."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from greenhouse_gym.capture import simulate_recording
from greenhouse_gym.crops import DEVELOPMENT_CULTIVARS, HELD_OUT_CULTIVARS, Cultivar, PlantRow, grow_row
from greenhouse_gym.crops.helios import grow_vine, pyhelios
from greenhouse_gym.crops.helios_meshes import _texture
from greenhouse_gym.crops.organs import ORGAN_KINDS, Organ, areas, fruit_ellipsoid, tube
from greenhouse_gym.errors import (
    FileFormatError,
    GrowthError,
    InvalidValueError,
    MissingDependencyError,
    UnknownNameError,
)
from greenhouse_gym.geometry import Ellipsoid

pytest.importorskip("pyhelios")
pytestmark = pytest.mark.xdist_group("helios")


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
    first, second = grow_vine.__wrapped__(11), grow_vine(11)
    assert np.array_equal(first.fronds[5].blade.vertices, second.fronds[5].blade.vertices)


def test_weeks_lower_the_same_trusses_and_ripen_them(row: PlantRow) -> None:
    later = grow_row(1, 0.4, week=1, source="helios")
    shared = {t.truss for t in row.tomatoes} & {t.truss for t in later.tomatoes}
    assert shared
    for truss in shared:
        before, after = ([t for t in one.tomatoes if t.truss == truss] for one in (row, later))
        assert np.mean([t.center[2] for t in after]) < np.mean([t.center[2] for t in before]) - 0.1
        assert np.mean([t.ripeness or 0 for t in after]) >= np.mean([t.ripeness or 0 for t in before])


def test_a_row_carries_its_leaf_area_and_redness() -> None:
    cultivar = Cultivar(leaf_area=2.2, leaf_redness=(-0.12, -0.11))
    leaves = [organ for organ in grow_row(1, 1.5, style=cultivar, source="helios").organs if organ.kind == "leaf"]
    carried = sum(areas(leaf.vertices, leaf.triangles).sum() for leaf in leaves)
    assert carried / 2.5 == pytest.approx(2.2, rel=0.25)  # plants stand half a metre beyond both ends
    red, green, _ = np.concatenate([leaf.colors for leaf in leaves]).T
    assert np.median((red - green) / (red + green)) == pytest.approx(-0.115, abs=0.03)


def test_fruit_has_the_cultivar_s_form() -> None:
    plums = grow_row(1, 0.4, style=Cultivar(aspect=(1.5, 1.5), ribs=(0.0, 0.0)), source="helios").tomatoes
    semi_axes = np.array([t.shape.semi_axes for t in plums if isinstance(t.shape, Ellipsoid)])
    assert semi_axes[:, 2] / semi_axes[:, :2].mean(axis=1) == pytest.approx(1.5, rel=0.03)


def test_no_held_out_cultivar_is_one_to_develop_with() -> None:
    assert not set(HELD_OUT_CULTIVARS) & set(DEVELOPMENT_CULTIVARS)
    assert not set(HELD_OUT_CULTIVARS.values()) & set(DEVELOPMENT_CULTIVARS.values())


def test_a_row_that_bears_no_fruit_says_so() -> None:
    with pytest.raises(GrowthError, match="no fruit in week 0"):
        grow_row(1, 0.4, style=replace(Cultivar(), count=(0, 0)), source="helios")


def test_a_vine_that_bears_no_fruit_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("greenhouse_gym.crops.helios.DAYS", 2)
    with pytest.raises(GrowthError, match="bears no f"):
        grow_vine.__wrapped__(5)


def test_another_version_is_refused_with_the_tried_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("greenhouse_gym.crops.helios.metadata.version", lambda name: "9.9")
    with pytest.raises(MissingDependencyError, match=r"0\.1\.38.*9\.9.*greenhouse-gym\[plants\]"):
        pyhelios.__wrapped__()


def test_a_missing_pyhelios_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyhelios", None)
    with pytest.raises(MissingDependencyError, match=r"greenhouse-gym\[plants\]"):
        pyhelios.__wrapped__()


def test_a_missing_texture_is_named() -> None:
    with pytest.raises(FileFormatError, match=r"gone\.png"):
        _texture("gone.png")


def test_growing_prints_nothing_and_leaves_quietly() -> None:
    code = "from greenhouse_gym.crops.helios import grow_vine; grow_vine(11); print('grown')"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (0, "grown\n", "")


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
