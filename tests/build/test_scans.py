"""Clouds from elsewhere: files of reference writers, and the same plant however its cloud is turned or scaled."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from greenhouse_gym.build import bank_builder as build
from greenhouse_gym.build.scans import RawCloud, Scan, extract_from_scan, open_scan, read_cloud, scanned_row
from greenhouse_gym.build.scans import scan as row_module
from greenhouse_gym.build.scans.frame import guess_unit, guess_up
from greenhouse_gym.build.scans.scan import fruit_hangs
from greenhouse_gym.capture.recordings import fingerprint
from greenhouse_gym.cli import app
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.errors import FileFormatError, GreenhouseError, InvalidValueError, UnknownNameError
from greenhouse_gym.geometry import Array, Sphere, invert, pose, transform
from greenhouse_gym.scene import Shapes
from greenhouse_gym.shapes import RowShapes

GREEN, RED = np.array([0.36, 0.50, 0.22]), np.array([0.76, 0.10, 0.07])


def skin(points: Array, color: Array, normals: Array) -> tuple[Array, Array, Array]:
    return points, np.tile(color, (len(points), 1)), normals


def rod(start: Array, end: Array, radius: float, random: np.random.Generator) -> tuple[Array, Array, Array]:
    """The side of a rod that faces the aisle."""
    along = end - start
    count = int(np.pi * radius * np.linalg.norm(along) / 0.0015**2)
    direction = along / np.linalg.norm(along)
    side = np.cross(direction, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    front = np.cross(side, direction)
    front *= -np.sign(front[0])
    angle = random.uniform(-np.pi / 2, np.pi / 2, count)[:, None]
    normals = np.cos(angle) * front + np.sin(angle) * side
    return skin(start + random.uniform(0, 1, (count, 1)) * along + radius * normals, GREEN, normals)


def ball(center: Array, radius: float, random: np.random.Generator) -> tuple[Array, Array, Array]:
    normals = random.normal(size=(int(4 * np.pi * radius**2 / 0.0018**2), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals[:, 0] < 0]
    return skin(center + radius * normals, RED, normals)


@cache
def plant() -> tuple[Array, Array, Array]:
    """Two stems and eight tomatoes that hang from short stalks; z up, seen from -x, metres."""
    random = np.random.default_rng(0)
    parts = []
    for y in (0.0, 0.4):
        parts.append(rod(np.array([0.5, y, 0.55]), np.array([0.5, y, 1.55]), 0.006, random))
        for k in range(4):
            z = 0.75 + 0.22 * k
            center = np.array([0.46, y + 0.05 * (-1) ** k, z])
            parts.append(ball(center, 0.026 + 0.002 * k, random))
            parts.append(rod(np.array([0.494, y, z + 0.06]), center + [0.0, 0.0, 0.029 + 0.002 * k], 0.0019, random))
    arrays = [np.concatenate(part) for part in zip(*parts, strict=True)]
    arrays[0] = arrays[0] + random.normal(0, 0.0003, arrays[0].shape)
    return arrays[0], arrays[1], arrays[2]


def scan_of(points: Array, normals: Array | None, **known: object) -> Scan:
    return open_scan(RawCloud(points, plant()[1], normals), **known)  # type: ignore[arg-type]


def assert_as_the_original(scan: Scan, back: Array, ends: bool = True) -> None:
    """Metres, z along the stems, normals out of the surfaces; ``back`` (3, 3) brings the metres of the file back."""
    points, _, normals = plant()
    found = transform(invert(scan.row_from_file), scan.cloud.points) @ back.T
    assert len(found) == pytest.approx(len(reference().cloud), rel=0.02)
    apart, nearest = cKDTree(points).query(found)
    assert np.quantile(apart, 0.99) < 0.0015
    out = scan.cloud.normals @ scan.row_from_file[:3, :3] @ back.T
    assert np.mean((out * normals[nearest]).sum(axis=1) > 0.5) > 0.9
    up = scan.row_from_file[2, :3] @ back.T
    np.testing.assert_allclose(up if ends else np.abs(up), [0, 0, 1], atol=0.02)
    assert (scan.row_from_file[0, :3] @ back.T)[0] > 0.9  # ahead is away from who looked


@cache
def reference() -> Scan:
    points, _, normals = plant()
    return scan_of(points, normals)


TURNS = {
    "as it is": np.eye(3),
    "y up": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "x up": np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]),
    "upside down": np.diag([1.0, -1, -1]),
    "seen from behind": np.diag([-1.0, -1, 1]),
    "any way": Rotation.from_rotvec([0.7, -0.4, 1.1]).as_matrix(),
    "mirrored": np.diag([1.0, -1, 1]),
}


@pytest.mark.parametrize("turn", TURNS)
def test_a_turned_or_mirrored_cloud_comes_to_stand_as_it_grew(turn: str) -> None:
    points, _, normals = plant()
    matrix = TURNS[turn]
    scan = scan_of(points @ matrix.T, normals @ matrix.T)
    assert_as_the_original(scan, matrix.T, ends=turn != "upside down")  # of stems alone, nobody knows


def test_a_cloud_turned_any_way_and_in_millimetres_gives_the_same_shapes() -> None:
    few = plant()[0][:, 1] < 0.2
    points, colors, normals = (part[few] for part in plant())
    turn = TURNS["any way"] @ np.diag([1.0, -1.0, 1.0])
    _, expected = extract_from_scan(open_scan(RawCloud(points, colors, normals)))
    scan, shapes = extract_from_scan(open_scan(RawCloud(1e3 * points @ turn.T, colors, -normals @ turn.T)))
    assert len(shapes.tomatoes) == len(expected.tomatoes) == 4
    there = transform(invert(scan.row_from_file), np.array([t.center for t in shapes.tomatoes])) @ turn
    assert np.linalg.norm(there[:, None] - [t.center for t in expected.tomatoes], axis=2).min(axis=1).max() < 0.002
    length = [sum(s.length for s in each.stems if s.kind == "main") for each in (shapes, expected)]
    assert length[0] == pytest.approx(length[1], abs=0.08)


def test_fruit_tells_which_end_is_up() -> None:
    scan = reference()
    fruit = [
        Tomato(Sphere([0.46, y + 0.05 * (-1) ** k, 0.75 + 0.22 * k], 0.026 + 0.002 * k), k)
        for y in (0, 0.4)
        for k in range(4)
    ]
    over = np.diag([1.0, -1.0, -1.0])
    turned = [tomato.transformed(pose(over)) for tomato in fruit]
    assert fruit_hangs(scan.cloud, RowShapes(tuple(fruit))) > 3.0
    assert fruit_hangs(scan.cloud.transformed(pose(over)), RowShapes(tuple(turned))) < -3.0
    assert fruit_hangs(scan.cloud, RowShapes(tuple(fruit[:5]))) == 0.0


def test_a_table_tells_which_way_is_up() -> None:
    """Before a camera that looks down at it, where nothing long and thin stands."""
    random = np.random.default_rng(0)
    flat = np.column_stack([random.uniform(-0.4, 0.4, (40_000, 2)), random.normal(0, 0.001, 40_000)])
    box = random.uniform([-0.1, -0.1, 0.0], [0.1, 0.1, 0.15], (20_000, 3))
    camera_from_table = pose(Rotation.from_euler("x", 125.0, degrees=True).as_matrix(), [0.0, 0.05, 0.8])
    points = transform(camera_from_table, np.concatenate([flat, box]))
    guess = guess_up(points)
    assert guess.value @ camera_from_table[:3, 2] > 0.999
    assert "normal to the plane" in guess.note
    assert guess_up(points - [0.0, 0.0, 2.0]).note.endswith("taken as the file's z")


@pytest.mark.parametrize(("scale", "unit"), [(1000.0, 0.001), (100.0, 0.01), (1.0, 1.0)])
def test_a_cloud_in_other_units_comes_out_in_metres(scale: float, unit: float) -> None:
    points, _, normals = plant()
    scan = scan_of(points * scale, normals)
    assert scan.unit == unit
    assert_as_the_original(scan, np.eye(3))


def test_a_scale_of_its_own_can_be_given() -> None:
    points, _, normals = plant()
    assert_as_the_original(scan_of(points / 0.37, normals, units=0.37), np.eye(3))


@pytest.mark.parametrize("change", ["inwards", "zero", "none", "mixed"])
def test_normals_are_turned_around_or_estimated(change: str) -> None:
    points, _, normals = plant()
    signs = np.where(np.random.default_rng(0).random((len(normals), 1)) < 0.5, -1.0, 1.0)
    changed = {"inwards": -normals, "zero": 0 * normals, "none": None, "mixed": signs * normals}[change]
    scan = scan_of(points, changed)
    assert_as_the_original(scan, np.eye(3))
    said = {
        "inwards": "turned around",
        "zero": "are zero; estimated",
        "none": "normals: estimated",
        "mixed": "to all sides",
    }
    assert said[change] in " ".join(scan.notes)


def test_what_is_given_is_not_guessed() -> None:
    points, colors, _ = plant()
    scan = open_scan(RawCloud(points, colors, None), units="m", up="x", seen_from=[-1.0, 0.2, 1.0])
    np.testing.assert_allclose(scan.row_from_file[2, :3], [1, 0, 0], atol=1e-12)
    assert not [note for note in scan.notes if note.startswith(("units", "up"))]
    toward = ([-1.0, 0.2, 1.0] - transform(invert(scan.row_from_file), scan.cloud.points)) @ scan.row_from_file[
        :3, :3
    ].T
    assert ((toward * scan.cloud.normals).sum(axis=1) >= 0).all()


@pytest.mark.parametrize(
    "bad", [{"units": "furlong"}, {"units": -1.0}, {"up": "w"}, {"up": [0, 0, 0]}, {"seen_from": [1]}]
)
def test_what_is_given_wrongly_is_refused(bad: dict[str, object]) -> None:
    with pytest.raises((InvalidValueError, UnknownNameError)):
        open_scan(RawCloud(*plant()), **bad)  # type: ignore[arg-type]


def test_an_unsure_unit_is_said() -> None:
    points, _, _ = plant()
    assert "might be" not in guess_unit(points).note
    assert "might be" in guess_unit(points * 30).note


def test_a_cloud_far_from_its_origin_is_brought_near() -> None:
    points, colors, normals = plant()
    scan = open_scan(RawCloud(points + [431_000.0, 5_600_000.0, 12.0], colors, normals))
    assert np.abs(scan.cloud.points).max() < 5.0
    assert any("origin" in note for note in scan.notes)


# -- a row of scenes --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("lift", "floor", "expected"), [(0.0, None, 0.0), (7.0, None, None), (7.0, 7.0, 0.0)])
def test_scenes_stand_on_the_floor(
    lift: float, floor: float | None, expected: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(row_module, "extract_from_scan", lambda scan, settings: (scan, lifted))
    points, colors, normals = plant()
    lifted = RowShapes(
        (Tomato(Sphere([0.5, 0.0, lift + 1.0], 0.03), 0),),
        (Stem([0.5, 0, lift + 0.6], [0.5, 0, lift + 1.6], 0.005, "main"),),
    )
    row = scanned_row(open_scan(RawCloud(points + [0, 0, lift], colors, normals), units="m"), floor)
    assert row.shapes.tomatoes[0].center[2] == pytest.approx(1.1 if expected is None else 1.0)
    assert row.row.world_from_station[0, 0, 3] == pytest.approx(0.0)
    assert any("not in the file" in note for note in row.scan.notes) == (expected is None)
    with pytest.raises(FileFormatError, match="no images"):
        row[0]


# -- files ------------------------------------------------------------------------------------------------------------


def with_open3d(path: Path, points: Array, colors: Array, normals: Array) -> None:
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.colors, cloud.normals = o3d.utility.Vector3dVector(colors), o3d.utility.Vector3dVector(normals)
    assert o3d.io.write_point_cloud(str(path), cloud)


def with_laspy(path: Path, points: Array, colors: Array, normals: Array) -> None:
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.scales = [0.0001] * 3
    content = laspy.LasData(header)
    content.xyz = points
    content.red, content.green, content.blue = np.rint(colors.T * 65535).astype(np.uint16)
    content.write(path)


def with_numpy(path: Path, points: Array, colors: Array, normals: Array) -> None:
    if path.suffix == ".npy":
        np.save(path, np.column_stack([points, colors, normals]).astype(np.float32))
    elif path.suffix == ".npz":
        np.savez(path, points=points, colors=np.rint(255 * colors).astype(np.uint8), normals=normals)
    else:
        np.savetxt(path, np.column_stack([points, 255 * colors, normals]))


def with_pye57(path: Path, points: Array, colors: Array, normals: Array) -> None:
    """Two scans, the second in a frame of its own."""
    pye57 = pytest.importorskip("pye57")
    lift, half = np.array([1.0, 2.0, 3.0]), len(points) // 2
    file = pye57.E57(str(path), mode="w")
    for part, place in ((slice(half), np.zeros(3)), (slice(half, None), lift)):
        columns = [*(points[part] - place).T, *np.rint(255 * colors[part]).astype(np.uint8).T]
        names = [f"cartesian{axis}" for axis in "XYZ"] + [f"color{name}" for name in ("Red", "Green", "Blue")]
        turn = np.array([1.0, 0.0, 0.0, 0.0])
        content = {name: np.ascontiguousarray(column) for name, column in zip(names, columns, strict=True)}
        file.write_scan_raw(content, rotation=turn, translation=place)
    file.close()


WRITERS = {".ply": with_open3d, ".pcd": with_open3d, ".las": with_laspy, ".laz": with_laspy,
           ".npy": with_numpy, ".npz": with_numpy, ".xyz": with_numpy, ".e57": with_pye57}  # fmt: skip


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_file_by_a_reference_writer_is_read_back(tmp_path: Path, suffix: str) -> None:
    points, colors, normals = plant()
    WRITERS[suffix](tmp_path / f"c{suffix}", points, colors, normals)
    cloud = read_cloud(tmp_path / f"c{suffix}")
    np.testing.assert_allclose(cloud.points, points, atol=1e-4)
    assert cloud.colors is not None
    np.testing.assert_allclose(cloud.colors, colors, atol=1 / 254)
    if suffix not in (".las", ".laz", ".e57"):
        assert cloud.normals is not None
        np.testing.assert_allclose(cloud.normals, normals, atol=1e-4)


@pytest.mark.parametrize("options", [{"write_ascii": True}, {"compressed": True}])
@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_text_and_compressed_files_of_open3d(tmp_path: Path, suffix: str, options: dict[str, bool]) -> None:
    points, colors, normals = plant()
    with_open3d(tmp_path / f"c{suffix}", points, colors, normals)
    cloud = open3d().io.read_point_cloud(str(tmp_path / f"c{suffix}"))
    open3d().io.write_point_cloud(str(tmp_path / f"d{suffix}"), cloud, **options)
    read = read_cloud(tmp_path / f"d{suffix}")
    np.testing.assert_allclose(read.points, points, atol=1e-4)
    np.testing.assert_allclose(read.colors, colors, atol=1 / 254)  # type: ignore[arg-type]
    np.testing.assert_allclose(read.normals, normals, atol=1e-4)  # type: ignore[arg-type]


def test_organized_clouds_and_rows_that_are_not_finite(tmp_path: Path) -> None:
    image = np.random.default_rng(0).random((20, 30, 3))
    image[3, 4] = np.nan
    np.save(tmp_path / "c.npy", image)
    cloud = read_cloud(tmp_path / "c.npy")
    assert cloud.points.shape == (599, 3)
    assert cloud.colors is None
    assert "1 of 600 points" in cloud.notes[0]


@pytest.mark.parametrize("suffix", WRITERS)
def test_of_too_many_points_some_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    monkeypatch.setattr("greenhouse_gym.build.scans.cloud_formats.columns.MAX_POINTS", 100)
    monkeypatch.setattr("greenhouse_gym.build.scans.cloud_formats.columns._PIECE", 70)
    random = np.random.default_rng(0)
    points, colors, normals = random.random((250, 3)), random.random((250, 3)), random.random((250, 3))
    WRITERS[suffix](tmp_path / f"c{suffix}", points, colors, normals)
    cloud = read_cloud(tmp_path / f"c{suffix}")
    np.testing.assert_allclose(cloud.points, points[::3], atol=1e-4)
    assert cloud.colors is not None
    np.testing.assert_allclose(cloud.colors, colors[::3], atol=1 / 254)
    assert "of 250 points one in 3 is used" in cloud.notes[0]


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".las", ".npy"])
def test_a_file_cut_short_is_refused(tmp_path: Path, suffix: str, text: bool) -> None:
    file = tmp_path / f"c{suffix}"
    WRITERS[suffix](file, *plant())
    if text and suffix in (".ply", ".pcd"):
        open3d().io.write_point_cloud(str(file), open3d().io.read_point_cloud(str(file)), write_ascii=True)
    assert len(read_cloud(file).points) == len(plant()[0])
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(FileFormatError, match=f"c{suffix}"):
        read_cloud(file)


def test_a_file_too_large_to_be_read_at_once_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("greenhouse_gym.build.scans.cloud_files._MAX_WHOLE", 1000)
    for suffix in (".npy", ".xyz"):
        with_numpy(tmp_path / f"c{suffix}", *plant())
    assert len(read_cloud(tmp_path / "c.xyz").points) == len(plant()[0])  # is read piece by piece
    with pytest.raises(FileFormatError, match="at most 1000 bytes; LAS, LAZ and text are read piece by piece"):
        read_cloud(tmp_path / "c.npy")


FEW, FOUR, NOTHING = np.random.default_rng(0).random((20, 3)), np.zeros((100, 4)), np.full((100, 3), np.nan)


@pytest.mark.parametrize(
    ("name", "content"),
    [("c.npy", FEW), ("c.npy", FOUR), ("c.npy", NOTHING)]
    + [(f"c.{kind}", None) for kind in ("npz", "ply", "pcd", "e57", "las", "laz", "xyz")],
)
def test_what_is_no_cloud_is_refused(tmp_path: Path, name: str, content: Array | None) -> None:
    if name.endswith(("las", "laz", "e57")):
        pytest.importorskip("pye57" if name.endswith("e57") else "laspy")
    if content is None:
        (tmp_path / name).write_bytes(b"ply no such thing\n\x00\xff")
    else:
        np.save(tmp_path / name, content)
    with pytest.raises(GreenhouseError, match=name):
        read_cloud(tmp_path / name)
    with pytest.raises(FileFormatError, match="no such file"):
        read_cloud(tmp_path / f"missing{Path(name).suffix}")


def test_no_colors_is_said() -> None:
    points, _, normals = plant()
    scan = open_scan(RawCloud(points, None, normals))
    assert any(note.startswith("no colors") for note in scan.notes)
    assert (scan.cloud.colors == 0.5).all()


# -- commands ---------------------------------------------------------------------------------------------------------


def test_the_command_writes_shapes_and_what_it_assumed(tmp_path: Path) -> None:
    few = plant()[0][:, 1] < 0.2
    points, colors, normals = (part[few] for part in plant())
    with_open3d(tmp_path / "c.ply", 1e3 * points, colors, normals)
    arguments = ["shapes", str(tmp_path / "c.ply"), "--out", str(tmp_path / "out"), "--up", "0,0,1"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert "units: taken as mm" in done.output
    assert "searching shapes in" in done.output
    assert "ShapeWarning" not in done.output
    found = Shapes.model_validate_json((tmp_path / "out" / "shapes.json").read_text())
    assert len(found.tomatoes) == 4
    assert json.loads((tmp_path / "out" / "report.json").read_text())["unit"] == 0.001
    assert len(read_cloud(tmp_path / "out" / "cloud.ply").points) > 1000
    wrong = CliRunner().invoke(app, [*arguments[:-1], "0,0,up"])
    assert "three numbers" in str(wrong.exception)


def test_a_bank_is_built_of_a_scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stems = (Stem([0.5, 0, 0.6], [0.5, 0, 1.6], 0.005, "main"),)
    found = RowShapes((Tomato(Sphere([0.46, 0.0, 1.0], 0.03), 0),), stems)
    monkeypatch.setattr(row_module, "extract_from_scan", lambda scan, settings: (scan, found))
    monkeypatch.setattr(build, "certify_targets", lambda scene, robot, **_: ())
    points, colors, normals = plant()
    rows = [scanned_row(open_scan(RawCloud(points, colors, normals), units="m", up=up)) for up in ("z", "-z")]
    bank = build.build_bank(rows[:1], tmp_path / "bank", "scanned", on_progress=lambda text: None)
    scene = bank[0]
    assert scene.tomatoes[0].center[0] == pytest.approx(0.56)
    assert scene.occupancy is None
    assert fingerprint(rows[0]) != fingerprint(rows[1])
