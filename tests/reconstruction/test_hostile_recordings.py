"""Recordings in which something is wrong: a clear refusal or a right row, never a wrong one."""

from __future__ import annotations

import json
import resource
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from row_helpers import Depth, from_stations, half_recording, with_depth, worst_errors

from greenhouse_gym.capture import Recording, RgbdFrame, Station, open_recording, write_recording
from greenhouse_gym.capture.formats.own import INDEX
from greenhouse_gym.capture.sensor import sense_depth
from greenhouse_gym.errors import FileFormatError, FileWriteError, InvalidValueError, ReconstructionError
from greenhouse_gym.geometry import transform
from greenhouse_gym.reconstruction import (
    ReconstructionSettings,
    RowCloud,
    TriangleMesh,
    reconstruct_row,
    reconstruct_segments,
    save_row,
    simplify_points,
    triangulate,
)
from greenhouse_gym.reconstruction.row_files import save_mesh, save_points
from greenhouse_gym.shapes import extract_shapes

pytestmark = pytest.mark.xdist_group("row")  # the row is rendered once

KNOWN = ReconstructionSettings(calibration_stations=0)
"""Calibration takes longer than all else in a recording of five stations."""


@cache
def plain_row() -> RowCloud:
    return reconstruct_row(half_recording(), KNOWN)


def recording_of(stations: list[Station]) -> Recording:
    return from_stations(stations, half_recording())


def refusal(stations: list[Station]) -> str:
    with pytest.raises(ReconstructionError) as caught:
        reconstruct_row(recording_of(stations), KNOWN)
    return str(caught.value)


# -- what the cameras see ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gray", "what"), [(0, "underexposed"), (255, "overexposed")])
def test_photographs_without_color_make_a_row_that_says_so_and_no_shapes(gray: int, what: str) -> None:
    stations = [
        Station(
            {
                name: RgbdFrame(np.full_like(frame.color, gray), frame.depth, frame.intrinsics)
                for name, frame in station.frames.items()
            },
            station.world_from_station,
        )
        for station in half_recording()
    ]
    row = reconstruct_row(recording_of(stations), KNOWN)
    assert row.registered.sum() == plain_row().registered.sum()
    assert any(what in warning for warning in row.report.warnings)
    with pytest.raises(InvalidValueError, match=what):
        extract_shapes(row.points, row.colors, row.normals)


def test_nothing_within_reach_is_refused_with_what_was_read() -> None:
    far = [with_depth(station, lambda _, depth: np.where(depth > 0, depth + 1.0, 0)) for station in half_recording()]
    message = refusal(far)
    assert "0 of 5 stations registered" in message
    for i in range(5):
        assert f"station {i}: camera 'middle': 0.0% foreground nearer than 0.6 m" in message
    assert message.count("median reading at 1.") == 5


def test_images_full_of_foreground_are_refused() -> None:
    rng = np.random.default_rng(0)
    full = [with_depth(s, lambda _, depth: rng.uniform(0.4, 0.45, depth.shape)) for s in half_recording()]
    message = refusal(full)
    assert "0 of 5 stations registered" in message
    assert "100.0% of the image is nearer than 0.6 m, at most 98% expected (median reading at 0.425 m" in message


@pytest.mark.parametrize("top", [1.1, 2.0])
def test_a_flat_wall_does_not_constrain_the_motion(top: float) -> None:
    """It stands half a metre away, up to the middle of the images or beyond, and looks the same all along the row."""
    rng = np.random.default_rng(0)

    def wall(name: str, depth: Depth) -> Depth:
        camera = half_recording().rig.cameras[name]
        at_one_metre = camera.intrinsics.back_project(*np.indices(depth.shape).reshape(2, -1), np.ones(depth.size))
        rays = at_one_metre @ camera.rig_from_camera[:3, :3].T
        distance = (0.5 - camera.rig_from_camera[0, 3]) / rays[:, 0]
        height = camera.rig_from_camera[2, 3] + distance * rays[:, 2]
        true = np.where((distance > 0) & (height < top), distance, np.inf).reshape(depth.shape)
        return sense_depth(true, camera.intrinsics.fx, rng)

    message = refusal([with_depth(station, wall) for station in list(half_recording())[:2]])
    assert "station 1: the surfaces are too even to constrain the motion" in message


def test_a_camera_that_is_dead_is_named_and_the_others_do() -> None:
    dead = recording_of([with_depth(s, lambda name, depth: depth * (name != "first")) for s in half_recording()])
    row = reconstruct_row(dead)
    assert row.registered.all()
    assert row.report.warnings == ("camera 'first' has no foreground at any station",)
    metres, degrees = worst_errors(row, dead)
    assert metres < 0.005
    assert degrees < 0.6
    bias = row.report.calibration.bias
    assert bias["first"] == 0.0
    assert max(map(abs, bias.values())) < 0.006  # the dead camera takes no part in what the others share


def test_a_reference_camera_that_is_dead_is_named() -> None:
    message = refusal([with_depth(s, lambda name, depth: depth * (name != "middle")) for s in half_recording()])
    for i in range(5):
        assert f"station {i}: camera 'middle': 0.0% foreground nearer than 0.6 m" in message
    assert "it has no readings" in message


# -- the order of the stations ----------------------------------------------------------------------------------------


def never_wrong(stations: list[Station]) -> tuple[RowCloud, ...]:
    recording = recording_of(stations)
    try:
        rows = reconstruct_segments(recording, KNOWN)
    except ReconstructionError:
        return ()
    for row in rows:
        metres, degrees = worst_errors(row, recording)
        assert metres < 0.02
        assert degrees < 2.0
    return rows


@pytest.mark.parametrize("order", [(2, 4, 1, 3, 0), (0, 2, 1, 3, 4), (0, 3, 2, 1, 4)])
def test_stations_in_the_wrong_order_get_no_wrong_pose(order: tuple[int, ...]) -> None:
    never_wrong([half_recording()[i] for i in order])


# -- readings that are none -------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
def test_readings_that_are_no_distances_are_none() -> None:
    rng = np.random.default_rng(0)
    nonsense = np.array([np.nan, np.inf, -np.inf, -0.4, 1e-30], dtype=np.float32)

    def damage(_: str, depth: Depth) -> Depth:
        return np.where(rng.random(depth.shape) < 0.15, rng.choice(nonsense, depth.shape), depth)

    damaged = recording_of([with_depth(station, damage) for station in half_recording()])
    row = reconstruct_row(damaged, KNOWN)
    assert row.registered.all()
    assert worst_errors(row, damaged)[0] < 0.006
    for name in ("points", "colors", "normals"):
        assert np.isfinite(getattr(row, name)).all()
    for end in (np.min, np.max):  # nothing where nothing is
        np.testing.assert_allclose(end(row.points, axis=0), end(plain_row().points, axis=0), atol=0.02)


# -- a hand in front of the cameras -----------------------------------------------------------------------------------

HAND = (200, 150, 130)


def with_hand(station: Station, shares: dict[str, float]) -> Station:
    """A round thing a quarter of a metre from the cameras covers these shares of their images."""
    frames = dict(station.frames)
    for name, share in shares.items():
        frame = frames[name]
        height, width = frame.depth.shape
        y, x = np.mgrid[:height, :width]
        radius = np.hypot((y - height / 2) / height, (x - width / 2) / width) / np.sqrt(share / np.pi)
        color, depth = frame.color.copy(), frame.depth.copy()
        color[radius < 1] = HAND
        depth[radius < 1] = 0.25 + 0.03 * radius[radius < 1] ** 2
        frames[name] = RgbdFrame(color, depth, frame.intrinsics)
    return Station(frames, station.world_from_station)


def points_of_hand(row: RowCloud) -> int:
    return int(np.count_nonzero(np.abs(255 * row.colors - HAND).max(axis=1) < 3))


def voxels_of_hand(name: str, share: float) -> int:
    """Return the number of points that it would leave in the cloud if none of them contradicted it."""
    frame = with_hand(half_recording()[2], {name: share}).frames[name]
    camera = half_recording().rig.cameras[name]
    points = transform(camera.rig_from_camera, frame.points((frame.color == HAND).all(axis=-1)))
    return len(np.unique(np.floor(points / KNOWN.voxel), axis=0))


def with_hand_at(at: int, shares: dict[str, float]) -> RowCloud:
    stations = list(half_recording())
    stations[at] = with_hand(stations[at], shares)
    row = reconstruct_row(recording_of(stations), KNOWN)
    assert worst_errors(row, half_recording())[0] < 0.006
    return row


def test_a_hand_in_front_of_the_cameras_costs_the_station() -> None:
    row = with_hand_at(2, {"middle": 0.5, "first": 0.2, "last": 0.2})
    np.testing.assert_array_equal(row.registered, [True, True, False, True, True])
    assert row.report.stations[2].reason
    assert points_of_hand(row) < 5


def test_a_hand_at_the_first_station_costs_it_too() -> None:
    """No earlier station can contradict it, so the second one is checked against it."""
    row = with_hand_at(0, {"first": 0.5})
    np.testing.assert_array_equal(row.registered, [False, True, True, True, True])
    assert "of the earlier station stands where this one sees through" in row.report.stations[1].reason
    assert points_of_hand(row) < 5


def test_a_small_hand_at_several_stations_is_no_plant() -> None:
    """It goes with the cameras, so the others see through it, except where they have no reading behind it."""
    stations = list(half_recording())
    for i in (1, 2, 3):
        stations[i] = with_hand(stations[i], {"middle": 0.06})
    row = reconstruct_row(recording_of(stations), KNOWN)
    assert worst_errors(row, half_recording())[0] < 0.006
    assert points_of_hand(row) < 0.35 * 3 * voxels_of_hand("middle", 0.06)


def test_what_remains_of_a_small_hand_is_what_no_other_station_sees_through() -> None:
    shown = with_hand_at(2, {"first": 0.1})
    assert shown.registered.all()
    assert points_of_hand(shown) < 0.35 * voxels_of_hand("first", 0.1)


# -- files ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_recording(half_recording(), tmp_path / "recording")


@pytest.mark.parametrize(
    ("scale", "reading"), [(1.0, r"median reading at \d{3} m"), (1e-6, r"median reading at 0\.000\d+ m")]
)
def test_a_depth_scale_that_is_off_by_a_thousand(folder: Path, scale: float, reading: str) -> None:
    index = json.loads((folder / INDEX).read_text())
    for camera in index["cameras"].values():
        camera["depth_scale"] = scale
    (folder / INDEX).write_text(json.dumps(index))
    with pytest.raises(ReconstructionError, match=rf"station 0: camera 'middle': 0\.0% foreground.*{reading}"):
        reconstruct_row(open_recording(folder), KNOWN)


def test_a_rig_file_whose_rotation_is_none(folder: Path) -> None:
    index = json.loads((folder / INDEX).read_text())
    index["cameras"]["last"]["rig_from_camera"][0][0] += 0.1
    (folder / INDEX).write_text(json.dumps(index))
    with pytest.raises(FileFormatError, match=r"recording\.json: .*camera 'last': rig_from_camera: not a rotation"):
        open_recording(folder)


def test_a_truncated_image_costs_its_station(folder: Path) -> None:
    file = folder / "depth" / "first" / "000002.png"
    file.write_bytes(file.read_bytes()[:-1000])
    recording = open_recording(folder)
    row = reconstruct_row(recording, KNOWN)
    np.testing.assert_array_equal(row.registered, [True, True, False, True, True])
    assert f"{file}: truncated" in row.report.stations[2].reason
    assert worst_errors(row, half_recording())[0] < 0.006


@contextmanager
def no_file_larger_than(size: int) -> Iterator[None]:
    """Writing more fails half way, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_while_a_recording_is_written(tmp_path: Path) -> None:
    with no_file_larger_than(100_000), pytest.raises(FileWriteError, match=r"000000\.png: cannot be written \("):
        write_recording(half_recording(), tmp_path)
    assert not (tmp_path / INDEX).exists()
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == []


@pytest.mark.parametrize("name", ["row.npz", "row.ply", "row.pcd", "row.xyz", "mesh.ply", "mesh.obj", "mesh.stl"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_full_disk_while_results_are_written(tmp_path: Path, name: str, share: float) -> None:
    path = tmp_path / name
    write_result(path)
    before = path.read_bytes()
    with no_file_larger_than(int(share * len(before))), pytest.raises(FileWriteError, match=rf"{name}: cannot be writ"):
        write_result(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def write_result(path: Path) -> None:
    if path.suffix == ".npz":
        save_row(plain_row(), path)
    elif path.stem == "row":
        save_points(simplify_points(plain_row(), 3000), path)
    else:
        save_mesh(plain_mesh(), path)


@cache
def plain_mesh() -> TriangleMesh:
    return triangulate(simplify_points(plain_row(), 3000), faces=None)


def test_a_full_disk_while_stations_are_written(tmp_path: Path) -> None:
    folder = tmp_path / "registration"
    with ExitStack() as disk, pytest.raises(FileWriteError, match=r"000003\.npz: cannot be written \(File too large"):
        reconstruct_row(
            half_recording(), KNOWN, folder=folder,
            on_station=lambda i: disk.enter_context(no_file_larger_than(100_000)) if i == 2 else None,
        )  # fmt: skip
    assert sorted(file.name for file in folder.iterdir()) == ["000000.npz", "000001.npz", "000002.npz"]
    row = reconstruct_row(half_recording(), KNOWN, folder=folder)
    np.testing.assert_array_equal(row.world_from_station, plain_row().world_from_station)
    np.testing.assert_array_equal(row.points, plain_row().points)
