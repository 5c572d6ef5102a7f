from __future__ import annotations

import numpy as np
import pytest
from row_helpers import half_recording
from scipy import ndimage

from greenhouse_gym.capture import Intrinsics, RgbdFrame
from greenhouse_gym.reconstruction import ReconstructionSettings
from greenhouse_gym.reconstruction.foreground import blacked_out, foreground_mask
from greenhouse_gym.reconstruction.registration import mean_offset, row_axis, silhouette_shift
from greenhouse_gym.reconstruction.shift import Shift, along, best_shift, overlap

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
    found = best_shift(first, second, axis, 20, 120)
    assert found is not None
    assert found == Shift(pixels, axis, 0.0)


def test_a_shift_between_two_tries_is_found_to_the_step() -> None:
    found = best_shift(cut(blobs(), 0, 0), cut(blobs(), 41, 0), 0, 20, 120, step=2)
    assert found is not None
    assert found.pixels in (40, 42)
    assert 0.0 < found.difference < 0.2


def test_noise_does_not_move_the_shift() -> None:
    random = np.random.default_rng(1)
    first, second = (cut(blobs(), start, 0) ^ (random.random((200, 160)) < 0.1) for start in (0, 50))
    found = best_shift(first, second, 0, 20, 120)
    assert found is not None
    assert found.pixels == 50


def test_nothing_to_compare() -> None:
    empty = np.zeros((200, 160), bool)
    assert best_shift(empty, empty, 0, 20, 120) is None
    edge = empty.copy()
    edge[:5] = True  # leaves the overlap with every shift that is tried
    assert best_shift(empty, edge, 0, 20, 120) is not None
    assert best_shift(empty, edge, 0, 300, 400) is None  # longer than the image


@pytest.mark.parametrize("shift", [-7, 0, 7])
def test_overlap_shows_the_same_pixels(shift: int) -> None:
    image = np.random.default_rng(0).random((40, 5))
    first, second = image[10:30], image[10 + shift : 30 + shift]
    a, b = overlap(first, shift, 0)
    np.testing.assert_array_equal(first[a], second[b])
    assert len(first[a]) == 20 - abs(shift)


def frame(depth: np.ndarray, color: int = 90) -> RgbdFrame:
    height, width = depth.shape
    intrinsics = Intrinsics(width, height, 100.0, 100.0, (width - 1) / 2, (height - 1) / 2)
    return RgbdFrame(np.full((height, width, 3), color, np.uint8), depth.astype(np.float32), intrinsics)


def test_foreground_is_what_is_nearer_than_60_cm() -> None:
    image = frame(np.array([[0.0, 0.3], [0.599, 0.601]]))
    np.testing.assert_array_equal(foreground_mask(image), [[False, True], [True, False]])
    np.testing.assert_array_equal(foreground_mask(image, 0.4), [[False, True], [False, False]])
    np.testing.assert_array_equal(blacked_out(image)[..., 0], [[0, 90], [90, 0]])


def shifted_frames(pixels: int, axis: int) -> tuple[RgbdFrame, RgbdFrame]:
    """A flat scene at half a metre that moves by so many pixels: the camera moves by pixels / fx * depth."""
    image = np.where(blobs(), 0.5, 0.0) if axis == 0 else np.where(blobs().T, 0.5, 0.0)
    return tuple(frame(cut(image, start, axis)) for start in (0, pixels))  # type: ignore[return-value]


@pytest.mark.parametrize("axis", [0, 1])
def test_mean_offset_of_a_flat_scene(axis: int) -> None:
    first, second = shifted_frames(40, axis)
    offset = mean_offset(first, second, Shift(40, axis, 0.0), SETTINGS)
    expected = np.zeros(3)
    expected[1 - axis] = 40 / 100 * 0.5
    np.testing.assert_allclose(offset, expected, atol=1e-6)


def test_mean_offset_leaves_out_pixels_that_hit_different_things() -> None:
    first, second = shifted_frames(40, 0)
    depth = second.depth.copy()
    depth[:, 80:] = np.where(depth[:, 80:] > 0, 0.58, 0.0)  # something else in half of the picture
    depth[:, :80] += np.where(depth[:, :80] > 0, np.float32(0.01), np.float32(0))
    offset = mean_offset(first, frame(depth), Shift(40, 0, 0.0), SETTINGS)
    assert offset is not None
    assert offset[2] == pytest.approx(-0.01, abs=1e-6)


def test_no_shared_pixels_no_offset() -> None:
    first, second = shifted_frames(40, 0)
    assert mean_offset(first, frame(np.zeros_like(second.depth)), Shift(40, 0, 0.0), SETTINGS) is None
    assert mean_offset(first, frame(second.depth + 0.2), Shift(40, 0, 0.0), SETTINGS) is None


def test_silhouettes_of_a_row_give_the_way_of_the_tripod() -> None:
    recording = half_recording()
    camera = recording.rig.cameras["middle"]
    assert row_axis(camera) == 0
    for i in range(3):
        one, two = recording[i], recording[i + 1]
        assert one.world_from_station is not None
        assert two.world_from_station is not None
        frames = one.frames["middle"], two.frames["middle"]
        shift = silhouette_shift(*frames, camera, 1, SETTINGS)
        assert isinstance(shift, Shift)
        assert shift.pixels > 0  # lower down in the first image
        offset = mean_offset(*frames, shift, SETTINGS)
        assert offset is not None
        head = np.append(camera.rig_from_camera[:3, 3], 1.0)
        true = (np.linalg.inv(one.world_from_station) @ two.world_from_station @ head)[1]
        along_row = (camera.rig_from_camera[:3, :3] @ offset)[1]
        assert along_row == pytest.approx(true, abs=0.04)  # only where ICP starts
        back = silhouette_shift(frames[1], frames[0], camera, 1, SETTINGS)
        assert isinstance(back, Shift)
        assert back.pixels < 0


def test_reasons_why_silhouettes_cannot_be_compared() -> None:
    recording = half_recording()
    camera = recording.rig.cameras["middle"]
    good = recording[0].frames["middle"]
    dark = RgbdFrame(good.color, np.zeros_like(good.depth), good.intrinsics)
    assert "second image has 0.0% foreground" in str(silhouette_shift(good, dark, camera, 1, SETTINGS))
    assert "first image has 0.0% foreground" in str(silhouette_shift(dark, good, camera, 1, SETTINGS))
    strict = ReconstructionSettings(max_shift_difference=0.01)
    assert "silhouettes differ by" in str(silhouette_shift(good, recording[1].frames["middle"], camera, 1, strict))
