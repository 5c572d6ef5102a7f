from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from row_helpers import half_recording
from scipy import ndimage

from greenhouse_gym.capture import SEED_RIG, Intrinsics, RgbdFrame, three_camera_rig
from greenhouse_gym.capture.rig import D435_DEPTH
from greenhouse_gym.geometry import transform
from greenhouse_gym.reconstruction import ReconstructionSettings, pair_registration
from greenhouse_gym.reconstruction.foreground import (
    Shift,
    along,
    best_shifts,
    black_out,
    foreground_mask,
    overlapping_parts,
)
from greenhouse_gym.reconstruction.pair_registration import mean_offset, row_axis, silhouette_shifts
from greenhouse_gym.reconstruction.station_views import Calibration, CameraView, camera_view

SETTINGS = ReconstructionSettings()


def blobs(shape: tuple[int, int] = (300, 160), seed: int = 0) -> np.ndarray:
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=shape), 6)
    return np.asarray(noise > 0.03)


def cut(image: np.ndarray, start: int, axis: int, size: int = 200) -> np.ndarray:
    return image[along(axis, slice(start, start + size))]


@pytest.mark.parametrize("pixels", [-60, -24, 24, 60, 98])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_known_shift_is_found_in_both_directions(pixels: int, axis: int) -> None:
    image = blobs() if axis == 0 else blobs().T
    first = cut(image, 100 if pixels < 0 else 0, axis)
    second = cut(image, (100 if pixels < 0 else 0) + pixels, axis)
    assert best_shifts(first, second, axis, 20, 120) == [Shift(pixels, axis, 0.0)]


def test_a_shift_between_two_tries_is_found_to_the_step() -> None:
    [found] = best_shifts(cut(blobs(), 0, 0), cut(blobs(), 41, 0), 0, 20, 120, step=2)
    assert found.pixels in (40, 42)
    assert 0.0 < found.difference < 0.2


def test_noise_does_not_move_the_shift() -> None:
    random = np.random.default_rng(1)
    first, second = (cut(blobs(), start, 0) ^ (random.random((200, 160)) < 0.1) for start in (0, 50))
    [found] = best_shifts(first, second, 0, 20, 120)
    assert found.pixels == 50


def test_nothing_to_compare() -> None:
    empty = np.zeros((200, 160), bool)
    assert best_shifts(empty, empty, 0, 20, 120) == []
    edge = empty.copy()
    edge[:5] = True  # leaves the overlap with every shift that is tried
    assert best_shifts(empty, edge, 0, 20, 120)
    assert best_shifts(empty, edge, 0, 300, 400) == []  # longer than the image


def test_a_row_that_repeats_itself_has_several_good_shifts() -> None:
    period = np.tile(blobs((60, 160)), (6, 1))
    period[200:230] ^= blobs((30, 160), seed=1)  # but is not quite the same everywhere
    found = best_shifts(period[:200], period[40:240], 0, 20, 120, count=3)
    assert found[0] == Shift(40, 0, 0.0)
    assert {-20, 100} & {shift.pixels for shift in found[1:]}
    differences = [shift.difference for shift in found]
    assert differences == sorted(differences)


@pytest.mark.parametrize("shift", [-7, 0, 7])
def test_overlap_shows_the_same_pixels(shift: int) -> None:
    image = np.random.default_rng(0).random((40, 5))
    first, second = image[10:30], image[10 + shift : 30 + shift]
    a, b = overlapping_parts(first, shift, 0)
    np.testing.assert_array_equal(first[a], second[b])
    assert len(first[a]) == 20 - abs(shift)


def view(depth: np.ndarray, color: int = 90) -> CameraView:
    """View of a camera at the origin of the rig that looks forward."""
    height, width = depth.shape
    intrinsics = Intrinsics(width, height, 100.0, 100.0, (width - 1) / 2, (height - 1) / 2)
    rig = three_camera_rig(intrinsics)
    image = RgbdFrame(np.full((height, width, 3), color, np.uint8), depth.astype(np.float32), intrinsics)
    return camera_view(image, "middle", Calibration(rig), SETTINGS)


def test_foreground_is_what_is_nearer_than_60_cm() -> None:
    depth = np.array([[0.0, 0.3], [0.599, 0.601]], dtype=np.float32)
    rig = three_camera_rig(Intrinsics(2, 2, 100.0, 100.0, 0.5, 0.5))
    camera = rig.cameras["middle"]
    mask = foreground_mask(depth, camera, rig)
    np.testing.assert_array_equal(mask, [[False, True], [True, False]])
    np.testing.assert_array_equal(foreground_mask(depth, camera, rig, 0.4), [[False, True], [False, False]])
    color = np.full((2, 2, 3), 90, np.uint8)
    np.testing.assert_array_equal(black_out(color, mask)[..., 0], [[0, 90], [90, 0]])


def test_turned_cameras_keep_the_slab_of_the_middle_one() -> None:
    depth = np.full((D435_DEPTH.height, D435_DEPTH.width), 0.5, dtype=np.float32)
    for depths in (depth, 1.1 * depth, 1.25 * depth):
        for camera in SEED_RIG.cameras.values():
            mask = foreground_mask(depths, camera, SEED_RIG)
            rows, columns = np.nonzero(depths > 0)
            points = camera.intrinsics.back_project(rows, columns, depths[rows, columns])
            np.testing.assert_array_equal(mask.ravel(), transform(camera.rig_from_camera, points)[:, 0] < 0.6)


def shifted_views(pixels: int, axis: int) -> tuple[CameraView, CameraView]:
    """A flat scene at half a metre that moves by so many pixels: the camera moves by pixels / fx * depth."""
    image = np.where(blobs(), 0.5, 0.0) if axis == 0 else np.where(blobs().T, 0.5, 0.0)
    return tuple(view(cut(image, start, axis)) for start in (0, pixels))  # type: ignore[return-value]


@pytest.mark.parametrize("axis", [0, 1])
def test_mean_offset_of_a_flat_scene(axis: int) -> None:
    first, second = shifted_views(40, axis)
    offset = mean_offset(first, second, Shift(40, axis, 0.0))
    expected = np.zeros(3)
    expected[1 - axis] = 40 / 100 * 0.5
    np.testing.assert_allclose(offset, expected, atol=1e-6)


def test_mean_offset_leaves_out_pixels_that_hit_different_things() -> None:
    first, second = shifted_views(40, 0)
    depth = second.depth.copy()
    depth[:, 100:] = np.where(depth[:, 100:] > 0, 0.58, 0.0)  # something else in a third of the picture
    depth[:, :100] += np.where(depth[:, :100] > 0, np.float32(0.01), np.float32(0))
    offset = mean_offset(first, view(depth), Shift(40, 0, 0.0))
    assert offset is not None
    assert offset[2] == pytest.approx(-0.01, abs=1e-6)


def test_no_shared_pixels_no_offset() -> None:
    first, second = shifted_views(40, 0)
    assert mean_offset(first, view(np.zeros_like(second.depth)), Shift(40, 0, 0.0)) is None
    assert mean_offset(first, view(second.depth + 0.2), Shift(40, 0, 0.0)) is None


def reference_view(i: int) -> CameraView:
    frame = half_recording()[i].frames["middle"]
    return camera_view(frame, "middle", Calibration(half_recording().rig), SETTINGS)


def test_silhouettes_of_a_row_give_the_way_of_the_tripod() -> None:
    recording = half_recording()
    camera = recording.rig.cameras["middle"]
    assert row_axis(camera) == 0
    for i in range(3):
        one, two = recording[i], recording[i + 1]
        assert one.world_from_station is not None
        assert two.world_from_station is not None
        views = reference_view(i), reference_view(i + 1)
        shifts = silhouette_shifts(*views, 1, SETTINGS)
        assert not isinstance(shifts, str)
        shift = shifts[0]
        assert shift.pixels > 0  # lower down in the first image
        offset = mean_offset(*views, shift)
        assert offset is not None
        head = np.append(camera.rig_from_camera[:3, 3], 1.0)
        true = (np.linalg.inv(one.world_from_station) @ two.world_from_station @ head)[1]
        along_row = (camera.rig_from_camera[:3, :3] @ offset)[1]
        assert along_row == pytest.approx(true, abs=0.04)  # only where ICP starts
        back = silhouette_shifts(*views[::-1], 1, SETTINGS)
        assert not isinstance(back, str)
        assert back[0].pixels < 0


def test_reasons_why_silhouettes_cannot_be_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    good, other = reference_view(0), reference_view(1)
    dark = replace(good, depth=np.zeros_like(good.depth), foreground=np.zeros_like(good.foreground))
    assert "second image has 0.0% foreground" in str(silhouette_shifts(good, dark, 1, SETTINGS))
    assert "first image has 0.0% foreground" in str(silhouette_shifts(dark, good, 1, SETTINGS))
    full = replace(good, depth=np.full_like(good.depth, 0.3), foreground=np.ones_like(good.foreground))
    assert "100.0% of the image is nearer than 0.6 m" in str(silhouette_shifts(good, full, 1, SETTINGS))
    monkeypatch.setattr(pair_registration, "MAX_SHIFT_DIFFERENCE", 0.01)
    assert "silhouettes differ by" in str(silhouette_shifts(good, other, 1, SETTINGS))
