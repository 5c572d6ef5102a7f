from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from row_helpers import HALF, grown

from greenhouse_gym.capture import SEED_RIG, Camera, Intrinsics, RgbdFrame, Rig, three_camera_rig
from greenhouse_gym.capture.raycast import RowRaycaster
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import distance_to_shapes, invert, pose, transform

SMALL = Intrinsics(212, 120, 106.05, 106.05, 105.5, 59.5)


def pixel(camera: Camera, world_from_station: np.ndarray, point: np.ndarray) -> np.ndarray:
    seen = transform(invert(world_from_station @ camera.rig_from_camera), point[None])[0]
    assert seen[2] > 0
    return (camera.intrinsics.matrix @ seen)[:2] / seen[2]


def test_the_papers_rig() -> None:
    assert list(SEED_RIG.cameras) == ["first", "middle", "last"]
    assert SEED_RIG.reference == "middle"
    positions = np.array([camera.rig_from_camera[:3, 3] for camera in SEED_RIG.cameras.values()])
    np.testing.assert_allclose(positions, [[0, -0.25, 1.1], [0, 0, 1.1], [0, 0.25, 1.1]])
    forward = np.array([camera.rig_from_camera[:3, 2] for camera in SEED_RIG.cameras.values()])
    s, c = np.sin(np.deg2rad(25)), np.cos(np.deg2rad(25))
    np.testing.assert_allclose(forward, [[c, s, 0], [1, 0, 0], [c, -s, 0]], atol=1e-12)  # the outer two look inwards


def test_silhouettes_move_up_in_the_image_as_the_tripod_goes_along_the_row() -> None:
    camera = SEED_RIG.cameras["middle"]
    point = np.array([0.5, 0.05, 1.1])
    before, after = (pixel(camera, pose(translation=[0, y, 0]), point) for y in (0.0, 0.1))
    assert after[1] - before[1] == pytest.approx(-camera.intrinsics.fy * 0.1 / 0.5)
    assert after[0] == pytest.approx(before[0])
    up = pixel(camera, pose(), point + [0, 0, 0.1])
    assert up[0] < before[0] - 10  # portrait: up in the world is left in the image
    assert up[1] == pytest.approx(before[1])


def test_silhouettes_of_a_rendered_row_move_up() -> None:
    camera = HALF.cameras["middle"]
    caster = RowRaycaster.of(grown())
    poses = [pose(translation=[0, y, 0]) @ camera.rig_from_camera for y in (0.2, 0.25)]
    views = [caster.render(each, camera.intrinsics) for each in poses]
    both = np.intersect1d(*(view.shape[view.depth < 0.6] for view in views))
    both = both[(both >= 0) & (both < len(grown().tomatoes))]
    moved = []
    for tomato in both:
        rows = [np.nonzero(view.shape == tomato)[0] for view in views]
        if min(map(len, rows)) > 80 and max(abs(r - 119.5).max() for r in rows) < 110:
            moved.append(rows[1].mean() - rows[0].mean())
    assert len(moved) >= 3
    assert max(moved) < -10


@pytest.mark.parametrize("portrait", [True, False])
@pytest.mark.parametrize("beam", ["level", "upright"])
def test_all_cameras_of_a_rig_see_one_world(beam: Literal["level", "upright"], portrait: bool) -> None:
    rig = three_camera_rig(SMALL, beam, portrait=portrait)
    positions = np.array([camera.rig_from_camera[:3, 3] for camera in rig.cameras.values()])
    along = 1 if beam == "level" else 2
    np.testing.assert_allclose(np.diff(positions[:, along]), 0.25)
    np.testing.assert_allclose(np.delete(positions, along, axis=1), np.delete(positions[[1, 1, 1]], along, axis=1))
    for camera in rig.cameras.values():  # the optical axes meet in front of the middle camera
        toward_middle = positions[1] - camera.rig_from_camera[:3, 3]
        assert camera.rig_from_camera[:3, 2] @ toward_middle >= -1e-12
        assert camera.rig_from_camera[0, 2] > 0.9
    station = pose(translation=[0.0, 0.25, 0.0])
    caster = RowRaycaster.of(grown())
    shapes = grown().shapes
    for camera in rig.cameras.values():
        view = caster.render(station @ camera.rig_from_camera, camera.intrinsics)
        depth = np.where(view.depth < 0.6, view.depth, 0).astype(np.float32)
        points = RgbdFrame(view.color, depth, camera.intrinsics).points()
        assert len(points) > 500
        in_world = transform(station @ camera.rig_from_camera, points)
        assert np.abs(distance_to_shapes(in_world, shapes)).min(axis=1).max() < 0.002


@pytest.mark.parametrize("name", ["width", "height", "fx", "fy", "cx", "cy"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0, 0.0])
def test_intrinsics_are_checked(name: str, value: float) -> None:
    good = {"width": 4, "height": 3, "fx": 2.0, "fy": 2.0, "cx": 1.5, "cy": 1.0}
    if name in ("cx", "cy") and np.isfinite(value):
        Intrinsics(**{**good, name: value})  # type: ignore[arg-type]
        return
    with pytest.raises(InvalidValueError, match=name):
        Intrinsics(**{**good, name: value})  # type: ignore[arg-type]


def test_rigs_and_cameras_are_checked() -> None:
    with pytest.raises(InvalidValueError, match="not a rotation"):
        Camera(SMALL, np.diag([1.0, 1.0, -1.0, 1.0]))
    with pytest.raises(InvalidValueError, match="finite 4x4 pose"):
        Camera(SMALL, np.eye(3))
    with pytest.raises(InvalidValueError, match="depth_scale"):
        Camera(SMALL, np.eye(4), depth_scale=-1.0)
    with pytest.raises(InvalidValueError, match="'b' is not among a"):
        Rig({"a": Camera(SMALL, np.eye(4))}, "b")


def test_a_rig_keeps_its_cameras() -> None:
    cameras = {"a": Camera(SMALL, np.eye(4))}
    rig = Rig(cameras, "a")
    cameras.clear()
    assert list(rig.cameras) == ["a"]
    with pytest.raises(ValueError, match="read-only"):
        rig.cameras["a"].rig_from_camera[0, 0] = 2.0
