"""Calibration of a rig from boards rendered through lenses, blurred and noisy."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from greenhouse_gym.capture import (
    Camera,
    Intrinsics,
    Recording,
    RgbdFrame,
    Rig,
    Station,
    three_camera_rig,
    write_recording,
)
from greenhouse_gym.capture.boards import Board, calibrate_from_boards, find_board
from greenhouse_gym.capture.rig_file import Mounting, load_mounting, save_mounting, with_mounting
from greenhouse_gym.cli import app
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.geometry import Array, invert, pose, rotation_about, rotation_angle

K = Intrinsics(640, 400, 460.0, 460.0, 319.5, 199.5)
BOARD = Board(7, 5, 0.035, 0.026)
PIXELS = 70  # per square in the drawing
BIAS = {"first": 0.01, "middle": 0.0, "last": -0.006}


def seen(camera_from_board: Array, seed: int, bias: float) -> RgbdFrame:
    """The board before gray, as a camera sees it, with noise and the depth error of the camera."""
    drawn = BOARD.to_opencv().generateImage((BOARD.columns * PIXELS, BOARD.rows * PIXELS))
    scale = BOARD.square / PIXELS
    from_pixel = np.array([[scale, 0, scale / 2], [0, scale, scale / 2], [0, 0, 0], [0, 0, 1.0]])
    plane = K.matrix @ camera_from_board[:3] @ from_pixel
    big = cv2.warpPerspective(drawn, plane, (K.width, K.height), flags=cv2.INTER_AREA, borderValue=128)
    random = np.random.default_rng(seed)
    noisy = cv2.GaussianBlur(big, (3, 3), 0.7) + random.normal(0, 4, big.shape)
    gray = np.clip(noisy, 0, 255).astype(np.uint8)
    normal, point = camera_from_board[:3, 2], camera_from_board[:3, 3]
    v, u = np.indices((K.height, K.width))
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(u.shape)], axis=-1)
    depth = (normal @ point) / (rays @ normal) * (1 + bias) + random.normal(0, 0.001, u.shape)
    return RgbdFrame(np.repeat(gray[..., None], 3, axis=2), np.clip(depth, 0, 3).astype(np.float32), K)


def true_rig() -> Rig:
    return three_camera_rig(K, portrait=False)


def knocked(rig: Rig, degrees: float) -> Rig:
    """The rig as its file says, with the last camera's place wrong."""
    there = rig.cameras["last"].rig_from_camera
    turned = pose(rotation_about([0.3, 1.0, 0.2], np.deg2rad(degrees)) @ there[:3, :3], there[:3, 3] + [0, 0.01, 0])
    return Rig({**rig.cameras, "last": Camera(K, turned)}, rig.reference)


@cache
def shown(seed: int = 0) -> tuple[Station, ...]:
    """The board at eight places about half a metre before the rig, tilted to and fro."""
    rig, random, stations = true_rig(), np.random.default_rng(seed), []
    for k in range(8):
        tilt = rotation_about(random.normal(size=3), 0.35)
        toward = np.column_stack([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]) @ tilt
        middle = np.array([0.50 + random.uniform(-0.05, 0.05), random.uniform(-0.08, 0.08), 1.1])
        corner = middle - toward @ [BOARD.columns * BOARD.square / 2, BOARD.rows * BOARD.square / 2, 0]
        board = pose(toward, corner)
        frames = {
            name: seen(invert(camera.rig_from_camera) @ board, 100 * seed + 10 * k + j, BIAS[name])
            for j, (name, camera) in enumerate(rig.cameras.items())
        }
        stations.append(Station(frames))
    return tuple(stations)


def test_a_rig_is_found_from_noisy_boards_and_a_knocked_camera_is_noticed() -> None:
    found = calibrate_from_boards(shown(), knocked(true_rig(), 3.0), BOARD)
    for name, camera in true_rig().cameras.items():
        apart = invert(camera.rig_from_camera) @ found.mounting.rig_from_camera[name]
        assert np.degrees(rotation_angle(apart[:3, :3])) < 0.2
        assert np.linalg.norm(apart[:3, 3]) < 0.002
        assert found.residual[name] < 0.5
        assert found.mounting.depth_error.get(name, 0.0) == pytest.approx(BIAS[name], abs=0.002)
    assert np.degrees(found.turned["last"]) == pytest.approx(3.0, abs=0.2)
    assert np.degrees(found.turned["first"]) < 0.2


def test_the_command_needs_the_place_of_one_camera_only(tmp_path: Path) -> None:
    rig = true_rig()
    nowhere = {name: replace(camera, rig_from_camera=np.eye(4)) for name, camera in rig.cameras.items()}
    board = ["--squares", "7x5", "--square", "0.035", "--marker", "0.026"]
    recording = Recording("board", Rig(nowhere, "middle"), 4, lambda i: shown()[i])
    source, nominal, out = (
        str(write_recording(recording, tmp_path / "board")),
        tmp_path / "nominal.yaml",
        tmp_path / "rig.yaml",
    )
    without = CliRunner().invoke(app, ["calibrate", source, "--out", str(out), *board])
    assert "a rig file with the pose of one of the cameras first, middle, last" in str(without.exception)
    save_mounting(Mounting({"middle": rig.cameras["middle"].rig_from_camera}, "middle"), nominal)
    known = ["calibrate", source, "--out", str(out), "--rig", str(nominal)]
    done = CliRunner().invoke(app, [*known, *board])
    assert "first: new in the rig file" in done.output
    assert "knocked" not in done.output
    for name, place in load_mounting(out).rig_from_camera.items():
        np.testing.assert_allclose(place, rig.cameras[name].rig_from_camera, atol=0.005)
    assert "has no pose of first, last" in str(CliRunner().invoke(app, [*known, "--no-board"]).exception)


def test_boards_that_few_cameras_see_are_reported() -> None:
    beside = seen(pose(translation=[9, 0, 1]), 0, 0)
    blind = [Station({**station.frames, "last": beside}) for station in shown()[:3]]
    with pytest.raises(InvalidValueError, match=r"last \(0 times\)"):
        calibrate_from_boards(blind, true_rig(), BOARD)
    assert find_board(blind[0].frames["last"], BOARD)[0] is None


@pytest.mark.parametrize("bad", [{"dictionary": "DICT_9X9"}, {"columns": 2}, {"marker": 0.05}])
def test_impossible_boards_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(InvalidValueError, match="board"):
        Board(**bad)  # type: ignore[arg-type]


def test_rig_files_are_read_back(tmp_path) -> None:  # type: ignore[no-untyped-def]
    rig = true_rig()
    given = Mounting(Mounting.of(rig).rig_from_camera, "middle", {"first": 0.01})
    read = load_mounting(save_mounting(given, tmp_path / "rig.yaml"))
    assert read.reference == "middle"
    assert read.depth_error == {"first": 0.01}
    for name, place in given.rig_from_camera.items():
        np.testing.assert_allclose(read.rig_from_camera[name], place, atol=1e-8)
    whole = (tmp_path / "rig.yaml").read_text()
    for content in ("", "cameras: {}", whole.replace("reference: middle", "reference: other")):
        (tmp_path / "bad.yaml").write_text(content)
        with pytest.raises(FileFormatError, match=r"bad\.yaml"):
            load_mounting(tmp_path / "bad.yaml")


def test_cameras_that_a_rig_file_does_not_name_are_left_out() -> None:
    from row_helpers import half_recording

    two = Mounting({"middle": np.eye(4), "last": pose(translation=[0, 0.2, 0])}, "middle")
    recording = with_mounting(half_recording(), two)
    assert set(recording[0].frames) == set(recording.rig.cameras) == {"middle", "last"}
    with pytest.raises(InvalidValueError, match="has the camera other"):
        with_mounting(half_recording(), Mounting({"other": np.eye(4)}, "other"))


@pytest.mark.parametrize(("columns", "rows"), [(8, 6), (6, 8), (5, 4), (7, 5)])
@pytest.mark.parametrize("legacy", [False, True])
def test_boards_of_both_layouts_are_found(columns: int, rows: int, legacy: bool) -> None:
    board = Board(columns, rows)
    picture = board.to_opencv(legacy).generateImage((60 * columns, 60 * rows), marginSize=20)
    k = Intrinsics(picture.shape[1], picture.shape[0], 500.0, 500.0, picture.shape[1] / 2, picture.shape[0] / 2)
    frame = RgbdFrame(np.dstack([picture] * 3), np.zeros(picture.shape, np.float32), k)
    found, _ = find_board(frame, board)
    assert found is not None
    assert len(found.pixels) == (columns - 1) * (rows - 1)
    np.testing.assert_allclose(found.camera_from_board[:3, :3], np.eye(3), atol=0.02)


@pytest.mark.parametrize("other", [Board(6, 8), Board(12, 9)])
def test_markers_of_another_board_are_reported(other: Board) -> None:
    picture = Board(8, 6).to_opencv().generateImage((480, 360), marginSize=20)
    k = Intrinsics(480, 360, 500.0, 500.0, 240.0, 180.0)
    frame = RgbdFrame(np.dstack([picture] * 3), np.zeros(picture.shape, np.float32), k)
    rig = Rig({name: Camera(k, np.eye(4)) for name in ("a", "b")}, "a")
    with pytest.raises(InvalidValueError, match=rf"2 images show its markers, .* {other.columns}x{other.rows} squares"):
        calibrate_from_boards([Station({"a": frame, "b": frame})], rig, other)
